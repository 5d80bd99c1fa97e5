"""Functions that all catch planners share: ordered targets, the net's axis, a bound on reach."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath, HarmonicPath, TargetPath, state_at
from planner_jax.robot.quadrotor import beyond_reach, greatest_speed
from planner_jax.task.catch.case import CatchCase

_RESTING = 1e-3  # [m/s], added upwards: much slower targets have no direction
_TIMES = 32  # times up to the horizon at which the bound on the reach is evaluated
_SLACK = 0.02  # [m], far more than the contact error that the referee accepts


@struct.dataclass
class CatchContext:
    """One case with its targets in the order of catching."""

    case: CatchCase
    targets: TargetPath  # the path pytree, leaves (N, ...)
    active: Array  # (N,) bool, False for absent targets
    horizon: Array  # (N,) [s]
    times: Array  # (N,) [s], first guess


def order_targets(case: CatchCase) -> CatchContext:
    """Return a case with its targets in the order of catching."""
    return CatchContext(
        case=case,
        targets=jax.tree.map(lambda leaf: leaf[case.order], case.targets),
        active=case.present[case.order],
        horizon=case.horizon[case.order],
        times=case.times,
    )


def targets_at(targets: TargetPath, times: Array) -> BallState:
    """Return the states of N targets, each at its own time (N,), leaves (N, 3)."""
    return jax.vmap(state_at)(targets, times)


def facing_cosine(axis: Array, vel: Array) -> tuple[Array, Array]:
    """Return cosines (N,) between unit axes of the net and -vel (N, 3), and which targets move."""
    speed_squared = jnp.sum(vel**2, axis=1)
    moving = speed_squared > 1e-12
    speed = jnp.sqrt(jnp.where(moving, speed_squared, 1.0))
    return -jnp.sum(axis * vel, axis=1) / speed, moving


def nearest_upright(vel: Array, lean: Array) -> Array:
    """Return the axes (N, 3) nearest to upright at an angle of at most `lean` from -vel (N, 3).

    Targets that rise are taken to fly level. For targets at rest the axis is upright. The lean
    () [rad] is from 0 to pi / 2.
    """
    back = jnp.concatenate([-vel[:, :2], jnp.maximum(-vel[:, 2:], 0.0) + _RESTING], axis=1)
    back /= jnp.sqrt(jnp.maximum(jnp.sum(back**2, axis=1, keepdims=True), 1e-6))
    level = jnp.sqrt(jnp.maximum(jnp.sum(back[:, :2] ** 2, axis=1, keepdims=True), 1e-6))
    cosine, sine, rise = jnp.cos(lean), jnp.sin(lean), back[:, 2:]
    # The direction back along the target's path, turned by the lean towards upright.
    turned = jnp.concatenate(
        [(cosine - sine * rise / level) * back[:, :2], cosine * rise + sine * level], axis=1
    )
    return jnp.where(rise >= cosine, jnp.array([0.0, 0.0, 1.0], vel.dtype), turned)


def is_too_far(context: CatchContext) -> Array:
    """Return whether a bound proves that the quadrotor cannot reach some target, () bool.

    At a catch the quadrotor is within height plus radius of the net from the target, and above its
    least height. The bound is evaluated at `_TIMES` times. A catch is within half a step of one of
    them, so the bound adds the distances that target and quadrotor move in half a step.

    False proves nothing. The result is false for optional targets, for targets that are neither
    `BallPath` nor `HarmonicPath`, and where a number is not finite.
    """
    case, targets = context.case, context.targets
    if case.optional or not isinstance(targets, BallPath | HarmonicPath):
        return jnp.zeros((), bool)
    net, limits, head_state = case.net, case.limits, case.head_state
    arm = jnp.abs(net.height) + net.radius + _SLACK
    fastest = greatest_speed(head_state, limits)
    shares = jnp.asarray((np.arange(_TIMES) + 0.5) / _TIMES, context.horizon.dtype)

    def is_away(target: BallPath | HarmonicPath, horizon: Array) -> Array:
        times, half_step = horizon * shares, 0.5 / _TIMES * horizon
        states = jax.vmap(target.at)(times)
        speed = jnp.sqrt(jnp.sum(states.vel**2, axis=1))
        bend = 0.5 * _greatest_acceleration(target, horizon) * half_step**2
        far = beyond_reach(states.pos, times, head_state, limits, case.gravity)
        apart = jnp.maximum(far, limits.min_height - states.pos[:, 2]) - arm
        return jnp.all(apart > (speed + fastest) * half_step + bend)

    return jnp.any(context.active & jax.vmap(is_away)(targets, context.horizon))


def _greatest_acceleration(target: BallPath | HarmonicPath, horizon: Array) -> Array:
    """Return a bound () [m/s^2] on a target's acceleration up to its horizon () [s]."""
    if isinstance(target, HarmonicPath):
        return jnp.sqrt(jnp.sum(target.amplitude**2)) * target.rate**2
    fastest = jnp.sqrt(jnp.sum(target.ball.vel**2)) + target.gravity * horizon
    return target.gravity + jnp.max(target.drag) * fastest
