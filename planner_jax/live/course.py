"""What is flown: a plan and the way to rest behind its end, or that way alone."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.live.packets import FIELDS
from planner_jax.robot.quadrotor import QuadrotorLimits
from planner_jax.robot.quadrotor_plan import setpoint_at
from planner_jax.task.catch.braking import braking
from planner_jax.trajectory.polynomial import (
    PiecewisePolynomial,
    evaluate,
    states_at,
    total_duration,
)


@struct.dataclass
class Course:
    """A trajectory that ends at rest, and stays there."""

    path: PiecewisePolynomial  # of M + 1 pieces, the last of which leads to rest
    gravity: Array  # () [m/s^2]
    keeps: Array  # () bool, whether the way to rest keeps the limits


def with_rest(path: PiecewisePolynomial, gravity: Array, limits: QuadrotorLimits) -> Course:
    """A plan's trajectory of M pieces, and the way to rest from its end; pure."""
    end = total_duration(path)
    state = jnp.stack([evaluate(path, end, order) for order in range(4)])
    return _joined(path, state, gravity, limits)


@struct.dataclass
class Stop:
    """A state from which to come to rest, and by which limits."""

    state: Array  # (4, 3), position to jerk
    gravity: Array  # () [m/s^2]
    limits: QuadrotorLimits


def to_rest(pieces: int, _: None, stop: Stop) -> Course:
    """The way to rest alone, behind M pieces that take no time; pure."""
    still = jnp.zeros((pieces, 8, 3), stop.state.dtype).at[:, 0].set(stop.state[0])
    path = PiecewisePolynomial(coeffs=still, durations=jnp.zeros(pieces, stop.state.dtype))
    return _joined(path, stop.state, stop.gravity, stop.limits)


def _joined(
    path: PiecewisePolynomial, state: Array, gravity: Array, limits: QuadrotorLimits
) -> Course:
    rest = braking(state, gravity, limits)
    whole = PiecewisePolynomial(
        coeffs=jnp.concatenate([path.coeffs, rest.coeffs[None]]),
        durations=jnp.append(path.durations, rest.duration),
    )
    return Course(path=whole, gravity=gravity, keeps=rest.possible)


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
    state = states_at(course.path, np.asarray(min(elapsed, end)))
    if elapsed >= end:
        state[1:] = 0.0
    return state.astype(np.float32)
