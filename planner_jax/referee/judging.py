"""Verdicts, and what every referee does with lanes: read them, share them, name failures."""

import dataclasses
import functools
import math
import operator
import os
import pickle
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

ABOVE_LIMIT = "{excess:.2%} above its limit at {time:.3f} s"  # sentence for a failed limit


@dataclasses.dataclass(frozen=True)
class Verdict:
    """The referee's decision on plans, one entry a plan; without an axis for a single plan.

    Measurements of a lane with inputs that are not finite may be NaN.
    """

    # Limit -> sentence for its failure, with `time`, `excess` and any field of the verdict; in the
    # order of the tests: a failed plan is named after its first failure.
    SENTENCES: ClassVar[dict[str, str]]
    # Limit -> sentence for an excess that is infinite.
    UNBOUNDED: ClassVar[dict[str, str]] = {}

    success: np.ndarray  # (B,) bool
    failed_limit: np.ndarray  # (B,) str, the first limit that fails; "" for a success
    failed_time: np.ndarray  # (B,) [s], where that limit is worst; NaN for a success
    # (B,), in the unit of the limit's sentence, tolerance included; NaN for a success.
    failed_excess: np.ndarray

    def sentence(self, k: int | None = None) -> str:
        """Return one line for a human: which limit failed, when, and the excess.

        Args:
            k: index of the plan; None for a verdict on one plan.
        """
        at = () if k is None else k
        name = str(np.asarray(self.failed_limit)[at])
        if not name:
            return f"success: {self.praise(at)}"
        time, excess = np.asarray(self.failed_time)[at], np.asarray(self.failed_excess)[at]
        text = self.UNBOUNDED.get(name) if np.isinf(excess) else None
        found = {field: np.asarray(value)[at] for field, value in vars(self).items()}
        text = (text or self.SENTENCES[name]).format(time=time, excess=excess, **found)
        return f"{name}: {text}"

    def praise(self, k: int | tuple) -> str:
        """Return the end of the sentence for a success."""
        return "every limit holds"


@dataclasses.dataclass(frozen=True)
class FlightVerdict(Verdict):
    """Verdict on plans of a quadrotor, with the measurements of the whole flight."""

    max_speed: np.ndarray  # (B,) [m/s]
    max_acceleration: np.ndarray  # (B,) [m/s^2]
    max_body_rate: np.ndarray  # (B,) [rad/s], infinite where the attitude is not defined
    min_height: np.ndarray  # (B,) [m]
    min_thrust: np.ndarray  # (B,) [m/s^2], per unit mass
    max_thrust: np.ndarray  # (B,) [m/s^2], per unit mass
    # (B,) [N], of one rotor; NaN where the case has no limits of rotors.
    min_rotor_thrust: np.ndarray
    max_rotor_thrust: np.ndarray
    continuity_error: np.ndarray  # (B,) [m], worst jump between pieces, as displacement
    head_error: np.ndarray  # (B,) [m], error at time 0, as displacement
    worst_extra: np.ndarray  # (B,) int, index of the extra with the worst excess; -1 without any


# Largest difference [s] between the claimed time of a contact and the one that is flown.
CONTACT_TIME_TOLERANCE = 1e-4
# Limits smaller than this (in their own unit) are compared as if relative to it.
SMALLEST_LIMIT = 1e-3
# Fewest lanes that are worth a thread.
_FEWEST_LANES = 256
# From these on processes judge instead of threads.
_MANY_LANES, _MANY_CORES = 16384, 4


def checked_leaf(name: str, value: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Return a leaf as an array; raise ValueError unless it has this shape."""
    leaf = np.asarray(value)
    if leaf.shape != shape:
        raise ValueError(f"{name} must be {shape}, got {leaf.shape}")
    return leaf


def read_leaves(
    tree: object, shapes: Mapping[str, tuple[int, ...]], num_lanes: int, prefix: str = ""
) -> dict[str, np.ndarray]:
    """Read arrays of a case or a plan, and check their shapes.

    Args:
        tree: object whose leaves have a leading axis of lanes.
        shapes: path of field names, such as "ball.pos", -> shape in one lane.
        num_lanes: B.
        prefix: put before each path in the names of the arrays and in errors.

    Returns:
        Arrays by name. A field that is None is left out.

    Raises:
        ValueError: an array has another shape.
    """
    values = {path: operator.attrgetter(path)(tree) for path in shapes}
    return {
        prefix + path: checked_leaf(prefix + path, value, (num_lanes, *shapes[path]))
        for path, value in values.items()
        if value is not None
    }


def flat(values: np.ndarray) -> np.ndarray:
    """Return (B, ...) as (B, N); the empty batch too."""
    return values.reshape(len(values), math.prod(values.shape[1:]))


def cut(num_lanes: int, size: int) -> list[slice]:
    """Cut lanes into slices of a size; one empty slice if there are no lanes."""
    return [slice(start, start + size) for start in range(0, max(num_lanes, 1), size)]


def judge_in_chunks(
    judge: Callable[[dict], dict], leaves: dict[str, np.ndarray], chunk: int
) -> dict[str, np.ndarray]:
    """Return the fields of a verdict from leaves with leading axis B, by chunks of lanes.

    Threads share the lanes, one for each core: NumPy releases the interpreter inside its loops.
    Processes share them if there are many lanes and many cores, and `judge` can be pickled.

    Raises:
        ValueError: `chunk` < 1.
    """
    if chunk < 1:
        raise ValueError(f"chunk must be >= 1, got {chunk}")
    num_lanes, num_cores = len(next(iter(leaves.values()))), cores()
    size = min(chunk, max(math.ceil(num_lanes / num_cores), _FEWEST_LANES))
    judge_part = functools.partial(_judge_in_float64, judge)
    cases = [{name: leaf[lanes] for name, leaf in leaves.items()} for lanes in cut(num_lanes, size)]
    if min(len(cases), num_cores) == 1:
        parts = [judge_part(case) for case in cases]
    elif num_cores >= _MANY_CORES and num_lanes >= _MANY_LANES and _can_be_sent(judge):
        from planner_jax.referee.workers import workers  # few batches are so large

        parts = workers().map(judge_part, cases)
    else:
        with ThreadPoolExecutor(num_cores) as pool:
            parts = list(pool.map(judge_part, cases))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _judge_in_float64(judge: Callable[[dict], dict], case: dict[str, np.ndarray]) -> dict:
    # A broken or absurd lane may overflow; its verdict reports that, not a warning.
    with np.errstate(all="ignore"):
        return judge({name: leaf.astype(np.float64) for name, leaf in case.items()})


def _can_be_sent(judge: Callable) -> bool:
    try:
        pickle.dumps(judge)
    except (pickle.PicklingError, AttributeError, TypeError):
        return False
    return True


def cores() -> int:
    """Return the number of cores to use: NPROC, as for XLA, or all that the process may use."""
    told = os.environ.get("NPROC", "")
    if told.isdecimal():
        return max(int(told), 1)
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # another system than Linux
        return os.cpu_count() or 1


def finite_lanes(case: dict, unbounded: tuple[str, ...] = ()) -> np.ndarray:
    """Return which lanes (B,) are finite; limits and `unbounded` may be infinite, but not NaN."""
    finite = np.ones(len(next(iter(case.values()))), bool)
    for name, leaf in case.items():
        limit = "limits." in name or name in unbounded
        good = ~np.isnan(leaf) if limit else np.isfinite(leaf)
        finite &= flat(good).all(axis=1)
    return finite


def first_failures(tests: dict, limits: tuple[str, ...], finite: np.ndarray) -> dict:
    """Return success, failed limit, its time and its excess of every lane.

    Tests are name -> failed, excess, time, each (B,), and `finite` (B,) bool says whether inputs
    are finite. `limits` are "not finite", then the names in the order of the tests; names without a
    test are skipped.
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


def above(value: np.ndarray, limit: np.ndarray, tolerance: float, time: np.ndarray) -> tuple:
    """Test value <= limit: failed, relative excess, time."""
    scale = np.where(np.isinf(limit), 1.0, np.maximum(np.abs(limit), SMALLEST_LIMIT))
    excess = (value - limit) / scale
    return excess > tolerance, excess, time


def derivative(coeffs: np.ndarray, times: np.ndarray, order: int) -> np.ndarray:
    """Return a derivative (3, ...) of polynomials (D + 1, 3, ...) at times (...) [s]."""
    value = np.zeros(np.broadcast_shapes(coeffs.shape[1:], times.shape))
    for k in range(len(coeffs) - 1, order - 1, -1):
        value *= times
        value += math.perm(k, order) * coeffs[k]
    return value
