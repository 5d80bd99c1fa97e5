"""Functions of all catch planners: order of targets, axis of the net, targets out of reach."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath, HarmonicPath, TargetPath, state_at
from planner_jax.robot.quadrotor import beyond_reach, greatest_speed
from planner_jax.task.catch.case import CatchCase

# [m/s], added upwards to a target's reversed velocity, so that the net is upright at zero velocity.
_RESTING = 1e-3
_TIMES = 32  # number of times up to the horizon at which `is_too_far` evaluates its bound
_SLACK = 0.02  # [m], margin of `is_too_far`; errors of catches that the referee accepts are smaller


@struct.dataclass
class CatchContext:
    """One case with its targets in the order of catching."""

    case: CatchCase
    targets: TargetPath  # paths of the targets, leaves (N, ...)
    active: Array  # (N,) bool, False for absent targets
    horizon: Array  # (N,) [s], latest time of each catch
    times: Array  # (N,) [s], first guess of the time of each catch


def order_targets(case: CatchCase) -> CatchContext:
    """Sort the targets of a case by `case.order`, the order in which they are caught."""
    return CatchContext(
        case=case,
        targets=jax.tree.map(lambda leaf: leaf[case.order], case.targets),
        active=case.present[case.order],
        horizon=case.horizon[case.order],
        times=case.times,
    )


def targets_at(targets: TargetPath, times: Array) -> BallState:
    """Return positions and velocities (N, 3) of N targets, each at its own time (N,) [s]."""
    return jax.vmap(state_at)(targets, times)


def nearest_upright(vel: Array, lean: Array) -> Array:
    """Return the axes (N, 3) of the net that are nearest to upright and still face N targets.

    An axis faces a target if its angle from the reversed velocity -vel (N, 3) is at most `lean` ()
    [rad], from 0 to pi / 2. Rising targets are treated as if they flew level.
    """
    back = jnp.concatenate([-vel[:, :2], jnp.maximum(-vel[:, 2:], 0.0) + _RESTING], axis=1)
    back /= jnp.sqrt(jnp.maximum(jnp.sum(back**2, axis=1, keepdims=True), 1e-6))
    level = jnp.sqrt(jnp.maximum(jnp.sum(back[:, :2] ** 2, axis=1, keepdims=True), 1e-6))
    cosine, sine, rise = jnp.cos(lean), jnp.sin(lean), back[:, 2:]
    # The reversed direction of flight, rotated by the angle `lean` towards the vertical.
    turned = jnp.concatenate(
        [(cosine - sine * rise / level) * back[:, :2], cosine * rise + sine * level], axis=1
    )
    return jnp.where(rise >= cosine, jnp.array([0.0, 0.0, 1.0], vel.dtype), turned)


def is_too_far(context: CatchContext) -> Array:
    """Return true only if the quadrotor provably cannot catch some target at any time, () bool.

    At a catch the quadrotor's distance from the target is at most height plus radius of the net,
    and the quadrotor is above its least height. These conditions are tested at 32 times. A
    catch is within half a step of such a time, so the distances that target and quadrotor can move
    in half a step are added.

    The result is false for optional targets, for targets that are neither `BallPath` nor
    `HarmonicPath`, and if a number is not finite.
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
    if isinstance(target, HarmonicPath):
        return jnp.sqrt(jnp.sum(target.amplitude**2)) * target.rate**2
    fastest = jnp.sqrt(jnp.sum(target.ball.vel**2)) + target.gravity * horizon
    return target.gravity + jnp.max(target.drag) * fastest
