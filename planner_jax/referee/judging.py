"""Parts that the referees, independent checks of plans, share: verdicts, shapes and threads."""

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

# Text for the violation of an upper limit: `{excess}` is the relative excess, `{time}` its time.
NOT_FINITE = "a number of the plan is not finite, or of its case, which pj.require_sound then names"
ABOVE_LIMIT = "{excess:.2%} above its limit at {time:.3f} s"


@dataclasses.dataclass(frozen=True)
class Verdict:
    """The referee's decision on B plans, with measurements.

    Arrays (B,) are () in the verdict on a single plan. Measurements are NaN where a number of the
    plan or of its case is not finite.

    Attributes:
        success: (B,) bool, whether the plan keeps every limit.
        failed_limit: (B,) str, the first limit that is exceeded; "" for a success.
        failed_time: (B,) [s], time at which that limit is exceeded most; NaN for a success.
        failed_excess: (B,) greatest excess over that limit, in the unit of the sentence in
            `SENTENCES`. The tolerance is not subtracted. NaN for a success.
    """

    # For each limit by name, the sentence that describes its violation. A sentence may contain
    # `{time}`, `{excess}` and any field of the verdict. The limits are tested in this order, and
    # `failed_limit` is the first limit whose test fails.
    SENTENCES: ClassVar[dict[str, str]]
    # For some limits by name, a sentence that replaces `SENTENCES` if the excess is infinite.
    UNBOUNDED: ClassVar[dict[str, str]] = {}

    success: np.ndarray
    failed_limit: np.ndarray
    failed_time: np.ndarray
    failed_excess: np.ndarray

    def sentence(self, k: int | None = None) -> str:
        """Describe in one line which limit plan `k` exceeds.

        For the verdict on a single plan `k` is left out, or 0. `IndexError` is raised for an index
        that no plan has.
        """
        shape = np.shape(self.success)
        at = () if k is None or (k == 0 and shape == ()) else k
        if isinstance(at, tuple) != (shape == ()):
            which = (
                f"{shape[0]} plans needs its index" if shape else "a single plan has the index 0"
            )
            raise IndexError(f"sentence(k) of the verdict on {which}, got k = {k}")
        name = str(np.asarray(self.failed_limit)[at])
        if not name:
            return f"success: {self.success_message(at)}"
        time, excess = np.asarray(self.failed_time)[at], np.asarray(self.failed_excess)[at]
        text = self.UNBOUNDED.get(name) if np.isinf(excess) else None
        found = {field: np.asarray(value)[at] for field, value in vars(self).items()}
        text = (text or self.SENTENCES[name]).format(time=time, excess=excess, **found)
        return f"{name}: {text}"

    def success_message(self, k: int | tuple) -> str:
        """Return the text that `sentence` reports for a successful plan `k`."""
        return "every limit holds"


@dataclasses.dataclass(frozen=True)
class FlightVerdict(Verdict):
    """Verdict on plans of a quadrotor, with extreme values that are measured over the flight."""

    max_speed: np.ndarray  # (B,) [m/s]
    max_acceleration: np.ndarray  # (B,) [m/s^2]
    max_body_rate: np.ndarray  # (B,) [rad/s], infinite if the attitude is undefined at some time
    min_height: np.ndarray  # (B,) [m]
    min_thrust: np.ndarray  # (B,) [m/s^2], per unit mass
    max_thrust: np.ndarray  # (B,) [m/s^2], per unit mass
    min_rotor_thrust: np.ndarray  # (B,) [N], of one rotor; NaN if the case does not limit rotors
    max_rotor_thrust: np.ndarray  # (B,) [N], of one rotor; NaN if the case does not limit rotors
    # Greatest angle between thrust and vertical in the recovery, and in the trajectory if its tilt
    # is limited; NaN without a recovery and a limit.
    max_tilt: np.ndarray  # (B,) [rad]
    # Greatest jump of the state between two pieces, and error of the state at time 0; an error of
    # velocity, acceleration or jerk counts as the displacement that it causes in a piece.
    continuity_error: np.ndarray  # (B,) [m]
    head_error: np.ndarray  # (B,) [m]
    worst_extra: np.ndarray  # (B,) int, index of the extra limit with the greatest excess, or -1


# [s] Greatest allowed difference between the time of a contact with the ball or target that a plan
# reports, and the time at the end of the trajectory's last piece before the contact.
CONTACT_TIME_TOLERANCE = 1e-4
# A relative excess is (value - limit) / |limit|; if |limit| is smaller than this number, the excess
# is divided by this number.
SMALLEST_LIMIT = 1e-3
_FEWEST_LANES = 256  # least number of plans that one thread judges
# Least numbers of plans and of cores with which processes instead of threads judge a batch.
_MANY_LANES, _MANY_CORES = 16384, 4


def check_leaf(name: str, value: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Convert `value` to an array; raise a ValueError with `name` unless its shape is `shape`."""
    leaf = np.asarray(value)
    if leaf.shape != shape:
        raise ValueError(f"{name} must be {shape}, got {leaf.shape}")
    return leaf


def read_leaves(
    tree: object, shapes: Mapping[str, tuple[int, ...]], num_lanes: int, prefix: str = ""
) -> dict[str, np.ndarray]:
    """Read arrays of cases or plans, by the dotted paths of their fields, and check their shapes.

    `shapes` are the shapes of the arrays of a single case, without the batch axis of length
    `num_lanes`. Names in the result and in errors start with `prefix`. None fields are left out.

    Raises:
        ValueError: an array does not have the shape (B, ...) that `shapes` requires.
    """
    values = {path: operator.attrgetter(path)(tree) for path in shapes}
    return {
        prefix + path: check_leaf(prefix + path, value, (num_lanes, *shapes[path]))
        for path, value in values.items()
        if value is not None
    }


def flat(values: np.ndarray) -> np.ndarray:
    """Flatten all axes behind the first: reshape (B, ...) to two axes, also if B is zero."""
    return values.reshape(len(values), math.prod(values.shape[1:]))


def cut(num_lanes: int, size: int) -> list[slice]:
    """Divide `num_lanes` plans into slices of at most `size`; no plans give one empty slice."""
    return [slice(start, start + size) for start in range(0, max(num_lanes, 1), size)]


def judge_in_chunks(
    judge: Callable[[dict], dict], leaves: dict[str, np.ndarray], chunk: int
) -> dict[str, np.ndarray]:
    """Judge B plans in chunks, and return the fields of their verdict as arrays (B, ...).

    At most `chunk` plans are judged together, to bound the memory. The chunks are divided among
    threads, one for each core, or for large batches among processes if `judge` can be pickled.
    """
    num_lanes, num_cores = len(next(iter(leaves.values()))), cores()
    size = min(chunk, max(math.ceil(num_lanes / num_cores), _FEWEST_LANES))
    judge_part = functools.partial(_judge_in_float64, judge)
    cases = [{name: leaf[lanes] for name, leaf in leaves.items()} for lanes in cut(num_lanes, size)]
    if min(len(cases), num_cores) == 1:
        parts = [judge_part(case) for case in cases]
    elif num_cores >= _MANY_CORES and num_lanes >= _MANY_LANES and _can_be_sent(judge):
        from planner_jax.referee.workers import map_in_processes  # few batches are so large

        parts = map_in_processes(judge_part, cases)
    else:
        with ThreadPoolExecutor(num_cores) as pool:
            parts = list(pool.map(judge_part, cases))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _judge_in_float64(judge: Callable[[dict], dict], case: dict[str, np.ndarray]) -> dict:
    # Very large numbers may overflow. The verdict reports them, so NumPy's warnings are off.
    with np.errstate(all="ignore"):
        return judge({name: leaf.astype(np.float64) for name, leaf in case.items()})


def _can_be_sent(judge: Callable) -> bool:
    try:
        pickle.dumps(judge)
    except (pickle.PicklingError, AttributeError, TypeError):
        return False
    return True


def cores() -> int:
    """Return the number of cores to use: the environment variable `NPROC`, or all that exist."""
    setting = os.environ.get("NPROC", "")
    if setting.isdecimal():
        return max(int(setting), 1)
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # another system than Linux
        return os.cpu_count() or 1


def finite_lanes(case: dict, unbounded: tuple[str, ...] = ()) -> np.ndarray:
    """Test which plans have finite numbers only; limits and fields `unbounded` may be infinite."""
    finite = np.ones(len(next(iter(case.values()))), bool)
    for name, leaf in case.items():
        good = ~np.isnan(leaf) if "limits." in name or name in unbounded else np.isfinite(leaf)
        finite &= flat(good).all(axis=1)
    return finite


def first_failures(tests: dict, limits: tuple[str, ...], finite: np.ndarray) -> dict:
    """Find the first failed limit of each plan, and return the fields of `Verdict`.

    Args:
        tests: by name of a limit, the arrays (failed, excess, time), each (B,) for B plans.
        limits: "not finite", then the names of limits in the order of the tests. A limit without
            an entry in `tests` is skipped.
        finite: (B,) bool, whether all numbers of the plan and its case are finite.
    """
    limits = (limits[0], *(name for name in limits[1:] if name in tests))
    failed, excess, time = (
        np.stack([tests[name][k] for name in limits[1:]], axis=1) for k in range(3)
    )
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


def clear_where(invalid: np.ndarray, tests: dict) -> dict:
    """Return all tests (failed, excess, time), set to passed with excess 0 for invalid plans."""
    return {
        name: (failed & ~invalid, np.where(invalid, 0.0, excess), time)
        for name, (failed, excess, time) in tests.items()
    }


def above(
    value: np.ndarray,
    limit: np.ndarray,
    tolerance: float,
    time: np.ndarray,
    smallest: float = SMALLEST_LIMIT,
) -> tuple:
    """Test value <= limit up to a relative tolerance; return (failed, relative excess, time).

    The excess is divided by `smallest` if the magnitude of the limit is smaller.
    """
    scale = np.where(np.isinf(limit), 1.0, np.maximum(np.abs(limit), smallest))
    excess = (value - limit) / scale
    return excess > tolerance, excess, time


def derivative(coeffs: np.ndarray, times: np.ndarray, order: int) -> np.ndarray:
    """Evaluate the `order`-th derivative of polynomials; the first axis of `coeffs` is powers."""
    value = np.zeros(np.broadcast_shapes(coeffs.shape[1:], times.shape))
    for k in range(len(coeffs) - 1, order - 1, -1):
        value *= times
        value += math.perm(k, order) * coeffs[k]
    return value
