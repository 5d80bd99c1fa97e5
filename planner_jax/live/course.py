"""What is flown: a plan and the way to rest behind its end, or that way alone."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.protocol import is_solved
from planner_jax.live.export_cache import traced
from planner_jax.live.packets import FIELDS
from planner_jax.optimise.problem import Round
from planner_jax.planning.programs import solve_cases
from planner_jax.planning.single_call import call_packed
from planner_jax.recovery.case import EndingCase
from planner_jax.recovery.planner import RestPlanner
from planner_jax.robot.quadrotor_plan import setpoint_at
from planner_jax.trajectory.polynomial import PiecewisePolynomial, states_at, total_duration

_REST = RestPlanner()


@struct.dataclass
class Course:
    """A trajectory that ends at rest, and stays there."""

    path: PiecewisePolynomial  # of M pieces, and those of the way to rest
    gravity: Array  # () [m/s^2]


def open_ended(path: PiecewisePolynomial, case: Any) -> Course:
    """A plan's trajectory of M pieces, behind whose end nothing is known yet; NumPy leaves."""
    end = _state_at(path, np.sum(path.durations))
    return Course(_behind(path, _still(_REST.num_pieces, end[0])), case.gravity)


def with_rest(path: PiecewisePolynomial, case: Any) -> tuple[Course, bool]:
    """A plan's trajectory of M pieces, and the way to rest from its end; NumPy leaves.

    Args:
        path: NumPy leaves.
        case: whose gravity and limits count.

    Returns:
        course: what is flown.
        keeps: whether its way to rest keeps the limits.
    """
    state: Any = _state_at(path, np.sum(path.durations))
    ending = EndingCase(state, state[0], case.gravity, case.limits)
    rest = call_packed(_rested, _REST.rounds[0], _REST, ending, compiler=traced)
    return Course(_behind(path, rest.trajectory), case.gravity), bool(is_solved(int(rest.status)))


def to_rest(state: np.ndarray, pieces: int, case: Any) -> tuple[Course, bool]:
    """As `with_rest`, from a state (4, 3), behind M pieces that take no time."""
    path = _still(pieces, state[0])
    path.coeffs[-1, :4] = state / np.array([[1.0], [1.0], [2.0], [6.0]])
    return with_rest(path, case)


def _still(pieces: int, place: np.ndarray) -> Any:
    """Pieces that take no time."""
    coeffs = np.zeros((pieces, 8, 3), np.float32)
    coeffs[:, 0] = place
    return PiecewisePolynomial(coeffs, np.zeros(pieces, np.float32))  # type: ignore[arg-type]


def _behind(path: Any, other: Any) -> Any:
    """One trajectory and then another."""
    parts = (path.coeffs, other.coeffs), (path.durations, other.durations)
    return PiecewisePolynomial(*map(np.concatenate, parts))  # type: ignore[arg-type]


def _rested(attempt: Round, planner: RestPlanner, case: EndingCase) -> Any:
    return solve_cases(planner, case, attempt)


@struct.dataclass
class Due:
    """A course, and when the first setpoint of it is due."""

    course: Course
    elapsed: Array  # () [s], since the course began
    period: Array  # () [s], between setpoints


def setpoints(num: int, _: None, due: Due) -> Array:
    """Setpoints (K, 20) of a course, the columns of `packets.FIELDS`; pure."""
    path, gravity = due.course.path, due.course.gravity
    times = due.elapsed + due.period * np.arange(num)
    end = total_duration(path)

    def at(time: Array) -> Array:
        moving = setpoint_at(path, gravity, jnp.minimum(time, end))
        zero = jnp.zeros(3, time.dtype)
        upright = jnp.asarray([1.0, 0.0, 0.0, 0.0], time.dtype)
        still = {**dict.fromkeys(("vel", "acc", "jerk", "body_rate"), zero), "pos": moving["pos"]}
        still |= {"quat_wxyz": upright, "thrust": gravity}
        rows = [jnp.where(time < end, moving[name], still[name]) for name in FIELDS]
        return jnp.concatenate([row.ravel() for row in rows])

    return jax.vmap(at)(times)


def state_of(course: Course, elapsed: float) -> np.ndarray:
    """Position to jerk (4, 3) of a course some time [s] since it began, on the host."""
    durations: Any = course.path.durations
    end = float(durations.sum())
    state = _state_at(course.path, min(elapsed, end))
    if elapsed >= end:
        state[1:] = 0.0
    return state


def _state_at(path: Any, elapsed: float) -> np.ndarray:
    return states_at(path, np.asarray(elapsed)).astype(np.float32)
