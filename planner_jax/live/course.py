"""The course of a robot in live planning: a trajectory that ends at standstill."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import Float

from planner_jax.core.protocol import is_solved
from planner_jax.live.packets import FIELDS
from planner_jax.optimise.planner import SearchPlanner
from planner_jax.planning.programs import solve_one
from planner_jax.recovery.case import RecoveryCase
from planner_jax.recovery.planner import RecoveryProblem
from planner_jax.robot.attitude import setpoint_at, tilt_quaternion, turn_quaternion, yaw_at
from planner_jax.robot.heading import KNOTS
from planner_jax.robot.quadrotor import (
    Air,
    QuadrotorLimits,
    QuadrotorPlan,
    add_drag,
    thrust_in_air,
)
from planner_jax.trajectory.polynomial import PiecewisePolynomial, states_at, total_duration

_REST = RecoveryProblem()
_REST_PLANNER = SearchPlanner(_REST)


@struct.dataclass
class Course:
    """A trajectory to standstill, at whose end the robot stays. The leaves are NumPy arrays."""

    path: PiecewisePolynomial  # M pieces of a plan, then the pieces of the recovery trajectory
    gravity: Array  # () [m/s^2], magnitude
    air: Air | None = None  # drag and wind
    heading: PiecewisePolynomial | None = None  # [rad], constant after its end; None: 0


def without_recovery(path: PiecewisePolynomial, gravity: Array, air: Air | None = None) -> Course:
    """Convert a plan's path to a course whose recovery trajectory (to standstill) lasts 0 s."""
    end = state_on(path, np.sum(path.durations))
    return Course(_join(path, _stand_still(_REST.num_pieces, end[0])), gravity, air)


def with_recovery(
    path: PiecewisePolynomial, gravity: Array, limits: QuadrotorLimits
) -> tuple[Course, bool]:
    """Append a trajectory to standstill to a plan's path; return both, and if the limits hold."""
    state: Any = state_on(path, np.sum(path.durations))
    case = RecoveryCase(state, state[0], gravity, limits.of_recovery(state, gravity))
    rest: QuadrotorPlan = solve_one(_REST_PLANNER, case, _REST.attempts[0])
    return Course(_join(path, rest.trajectory), gravity, limits.air), bool(is_solved(rest.status))


def recovery_from(
    state: Float[np.ndarray, "4 3"], pieces: int, gravity: Array, limits: QuadrotorLimits
) -> tuple[Course, bool]:
    """Plan a trajectory from a state to standstill; return it, and whether it keeps the limits.

    `state` has the rows position, velocity, acceleration and jerk. The result starts with `pieces`
    pieces of zero duration, so that it has as many pieces as the course of a plan.
    """
    path = _stand_still(pieces, state[0])
    path.coeffs[-1, :4] = state / np.array([[1.0], [1.0], [2.0], [6.0]])
    return with_recovery(path, gravity, limits)


def _stand_still(pieces: int, pos: np.ndarray) -> PiecewisePolynomial:
    coeffs: Any = np.zeros((pieces, 8, 3), np.float32)
    durations: Any = np.zeros(pieces, np.float32)
    coeffs[:, 0] = pos
    return PiecewisePolynomial(coeffs, durations)


def _join(path: PiecewisePolynomial, other: PiecewisePolynomial) -> PiecewisePolynomial:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), path, other)


@struct.dataclass
class Query:
    """A request for setpoints: a trajectory to standstill, and the times of the setpoints."""

    course: Course
    elapsed: Array  # () [s], time from the start of the course to the first setpoint
    period: Array  # () [s], time between setpoints


def setpoints_of(num: int, _: None, query: Query) -> Float[Array, "K 20"]:
    """Return K = `num` setpoints: pos, vel, acc, jerk, quat_wxyz, body_rate, thrust."""
    path, gravity, heading = query.course.path, query.course.gravity, query.course.heading
    times = query.elapsed + query.period * np.arange(num)
    end = total_duration(path)

    def at(time: Array) -> Array:
        moving = setpoint_at((path, gravity, query.course.air, heading), jnp.minimum(time, end))
        zero = jnp.zeros(3, time.dtype)
        upright = jnp.asarray([1.0, 0.0, 0.0, 0.0], time.dtype)
        still = {**dict.fromkeys(("vel", "acc", "jerk", "body_rate"), zero), "pos": moving["pos"]}
        still |= {"quat_wxyz": upright, "thrust": gravity}
        if (air := query.course.air) is not None:  # hover against the wind
            load = add_drag(air, zero, zero)
            still["quat_wxyz"] = tilt_quaternion(load, gravity)
            still["thrust"] = thrust_in_air(air, zero, load, gravity)
        if heading is not None:
            still["quat_wxyz"] = turn_quaternion(still["quat_wxyz"], yaw_at(heading, time)[0])
        rows = [jnp.where(time < end, moving[name], still[name]) for name in FIELDS]
        return jnp.concatenate([row.ravel() for row in rows])

    return jax.vmap(at)(times)


def state_of(course: Course, elapsed: float) -> Float[np.ndarray, "4 3"]:
    """Return position, velocity, acceleration, jerk at `elapsed` [s]; after the end: standstill."""
    end = float(np.sum(course.path.durations))
    state = state_on(course.path, min(elapsed, end))
    if elapsed >= end:
        state[1:] = 0.0
    return state


def state_on(path: PiecewisePolynomial, elapsed: float) -> Float[np.ndarray, "4 3"]:
    """Return position, velocity, acceleration and jerk at the time `elapsed` [s], as float32."""
    return states_at(path, np.asarray(elapsed)).astype(np.float32)


def hold_heading(angle: float) -> PiecewisePolynomial:
    """Return a constant heading [rad], with as many pieces as the heading of a plan."""
    coeffs: Any = np.zeros((KNOTS, 3, 1), np.float32)
    coeffs[:, 0] = angle
    durations: Any = np.zeros(KNOTS, np.float32)
    return PiecewisePolynomial(coeffs, durations)


def yaw_of(course: Course, elapsed: float) -> Float[np.ndarray, " 2"] | None:
    """Return heading and derivative [rad], [rad/s] at `elapsed` [s]; None without a heading."""
    if (heading := course.heading) is None:
        return None
    return state_on(heading, min(elapsed, float(np.sum(heading.durations))))[:2, 0]
