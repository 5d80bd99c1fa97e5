"""What every referee does with lanes: checks leaves, shares lanes out, names first failures.

In float64 NumPy; it shares no code with the planners.
"""

import functools
import math
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from planner_jax.referee.workers import cores, workers

# Largest difference [s] between the claimed time of a contact and the one that is flown.
CONTACT_TIME_TOLERANCE = 1e-4
# Limits smaller than this (in their own unit) are compared as if relative to it.
SMALLEST_LIMIT = 1e-3
# Fewest lanes that are worth a thread.
_FEWEST_LANES = 256
# From these on processes judge instead of threads.
_MANY_LANES, _MANY_CORES = 16384, 4


def checked_leaf(name: str, value, shape: tuple[int, ...]) -> np.ndarray:
    """A leaf as an array; ValueError if it does not have this shape."""
    leaf = np.asarray(value)
    if leaf.shape != shape:
        raise ValueError(f"{name} must be {shape}, got {leaf.shape}")
    return leaf


def flat(values: np.ndarray) -> np.ndarray:
    """(B, ...) as (B, N); the empty batch too."""
    return values.reshape(len(values), math.prod(values.shape[1:]))


def cut(num_lanes: int, size: int) -> list[slice]:
    """Runs of so many lanes; one of no lanes if there are none."""
    return [slice(start, start + size) for start in range(0, max(num_lanes, 1), size)]


def judge_in_chunks(
    judge: Callable[[dict], dict], leaves: dict[str, np.ndarray], chunk: int
) -> dict[str, np.ndarray]:
    """The fields of a verdict from leaves with leading axis B, up to `chunk` lanes at once.

    The lanes are shared among threads, one for each core that it may keep busy: NumPy lets go of
    the interpreter inside its loops. Many lanes and many cores are worth processes, if `judge` can
    be sent.
    """
    num_lanes, num_cores = len(next(iter(leaves.values()))), cores()
    size = min(chunk, max(math.ceil(num_lanes / num_cores), _FEWEST_LANES))
    judged = functools.partial(_judged, judge)
    cases = [{name: leaf[lanes] for name, leaf in leaves.items()} for lanes in cut(num_lanes, size)]
    if min(len(cases), num_cores) == 1:
        parts = [judged(case) for case in cases]
    elif num_cores >= _MANY_CORES and num_lanes >= _MANY_LANES and _can_be_sent(judge):
        parts = workers().map(judged, cases)
    else:
        with ThreadPoolExecutor(num_cores) as pool:
            parts = list(pool.map(judged, cases))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _judged(judge: Callable[[dict], dict], case: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    # A broken or absurd lane may overflow; its verdict says so, not a warning.
    with np.errstate(all="ignore"):
        return judge({name: leaf.astype(np.float64) for name, leaf in case.items()})


def _can_be_sent(judge: Callable) -> bool:
    try:
        pickle.dumps(judge)
    except (pickle.PicklingError, AttributeError, TypeError):
        return False
    return True


def finite_lanes(case: dict, unbounded: tuple[str, ...] = ()) -> np.ndarray:
    """Lanes (B,) whose inputs are finite; limits and `unbounded` may be infinite, but not NaN."""
    finite = np.ones(len(next(iter(case.values()))), bool)
    for name, leaf in case.items():
        limit = "limits." in name or name in unbounded
        good = ~np.isnan(leaf) if limit else np.isfinite(leaf)
        finite &= flat(good).all(axis=1)
    return finite


def first_failures(tests: dict, limits: tuple[str, ...], finite: np.ndarray) -> dict:
    """Success, failed limit, its time and excess of every lane.

    Args:
        tests: name -> failed, excess, time, each (B,).
        limits: the names in the order in which they are tested, after "not finite"; those without
            a test are passed over.
        finite: (B,) bool, lanes whose inputs are.
    """
    limits = (limits[0], *(name for name in limits[1:] if name in tests))
    failed = np.stack([tests[name][0] for name in limits[1:]], axis=1)
    excess = np.stack([tests[name][1] for name in limits[1:]], axis=1)
    time = np.stack([tests[name][2] for name in limits[1:]], axis=1)
    finite = finite & ~np.isnan(excess).any(axis=1)
    success = finite & ~failed.any(axis=1)
    first = failed.argmax(axis=1)
    lanes = np.arange(len(first))
    names = np.where(success, "", np.where(finite, np.array(limits)[1 + first], limits[0]))
    broken = finite & ~success
    return {
        "success": success,
        "failed_limit": names,
        "failed_time": np.where(broken, time[lanes, first], np.nan),
        "failed_excess": np.where(broken, excess[lanes, first], np.nan),
    }


def above(value, limit, tolerance: float, time) -> tuple:
    """Test of value <= limit: failed, relative excess, time."""
    scale = np.where(np.isinf(limit), 1.0, np.maximum(np.abs(limit), SMALLEST_LIMIT))
    excess = (value - limit) / scale
    return excess > tolerance, excess, time


def derivative(coeffs: np.ndarray, times: np.ndarray, order: int) -> np.ndarray:
    """A derivative (3, ...) of polynomials (D + 1, 3, ...) at times (...) since they began."""
    value = np.zeros(np.broadcast_shapes(coeffs.shape[1:], times.shape))
    for k in range(len(coeffs) - 1, order - 1, -1):
        value *= times
        value += math.perm(k, order) * coeffs[k]
    return value
