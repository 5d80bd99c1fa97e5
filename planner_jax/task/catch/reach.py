"""Whether targets can be caught at all: a bound that no plan can beat."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.ball.target import BallPath, HarmonicPath
from planner_jax.robot.quadrotor_reach import beyond_reach, greatest_speed
from planner_jax.task.catch.chain import CatchContext

_TIMES = 32  # up to the horizon, at which every target is looked at
_SLACK = 0.02  # [m], far more than a plan that passes the referee may be off its target


def is_too_far(context: CatchContext) -> Array:
    """Whether the quadrotor can be near some target at no time up to its horizon, () bool.

    At a catch it is no farther from the target than height and radius of its net, and above its
    least height. A catch is within half a step of one of the times that are looked at, in which
    target and quadrotor move by what is added to the distance.

    False does not say that there is a plan. It is false for targets that may be left, for those of
    a class that does not say how it accelerates, and where a number is not finite.

    Args:
        context: of one case.
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
    """Of a target up to a time () [s], a bound, () [m/s^2]."""
    if isinstance(target, HarmonicPath):
        return jnp.sqrt(jnp.sum(target.amplitude**2)) * target.rate**2
    fastest = jnp.sqrt(jnp.sum(target.ball.vel**2)) + target.gravity * horizon
    return target.gravity + jnp.max(target.drag) * fastest
