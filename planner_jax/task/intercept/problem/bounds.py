"""Bounds of the distances that a car drives, which prove that no motion meets a target."""

import jax.numpy as jnp
import numpy as np
from jax import Array, lax, vmap

from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.problem.clearance import wrap

_HIGHEST = lax.Precision.HIGHEST
# Numbers of intervals of a free meeting time, and of directions, in the bounds of `is_too_far`.
_INTERVALS, _DIRECTIONS = 64, 32
_EXCESS = 1.002  # factor on distances of drives: the referee accepts limits exceeded by 0.1 %


def is_too_far(case: InterceptCase, *, is_time_free: bool) -> Array:
    """Return whether the car cannot drive far enough to meet the target, at any allowed time.

    The meeting is at the case's time, or from the earliest time to the case's time if it is free.
    This time is divided into intervals. In an interval the target is not farther from its position
    at the middle than it moves in a whole interval at its greatest speed.
    """
    num = _INTERVALS if is_time_free else 1
    step = jnp.maximum(case.time - case.earliest, 0.0) / num if is_time_free else 0.0 * case.time
    ends = case.time - step * jnp.arange(num, dtype=case.time.dtype)
    target = vmap(case.target.at)(ends - 0.5 * step)
    spread = step * jnp.sqrt(jnp.max(jnp.sum(target.vel**2, axis=1)))
    least = vmap(lambda pos: shortest_drive(case, pos, spread))(target.pos)
    return jnp.all(least > _EXCESS * longest_drive(case, ends))


def shortest_drive(case: InterceptCase, goal: Array, spread: Array) -> Array:
    """Return a lower bound () [m] of the distance that the car drives to a meeting at `goal` (2,).

    The target may be up to `spread` () [m] away from `goal`. Obstacles are ignored. After the
    distance s the heading has changed by at most s / r, with the least turning radius r. The
    displacement along a unit vector at the angle phi from the heading at the start is therefore at
    most the integral of cos(max(phi - s / r, 0)). In reverse gear pi - phi takes the place of phi.
    The result is the greatest bound of several vectors.
    """
    body, bend = case.body, case.limits.curvature
    radius, start, tolerance = 1.0 / bend, case.start[2], case.heading_tolerance
    is_free = tolerance >= np.pi
    ahead = body.middle * jnp.stack([jnp.cos(case.end_heading), jnp.sin(case.end_heading)])
    away = goal - case.start[:2] - jnp.where(is_free, 0.0, ahead)
    around = spread + case.tolerance + jnp.abs(body.middle) * jnp.where(is_free, 1.0, tolerance)
    angles = jnp.asarray(np.pi * (np.arange(_DIRECTIONS) + 1 - _DIRECTIONS // 2), away.dtype)
    angles = angles / (_DIRECTIONS // 2)
    normals = jnp.stack([jnp.cos(start + angles), jnp.sin(start + angles)], axis=1)
    region = away[None] + case.region
    beside = jnp.min(jnp.matmul(normals, region.T, precision=_HIGHEST), axis=1) - around
    far = jnp.maximum(beside, 0.0)
    turn = jnp.abs(angles)
    turn = jnp.where(case.limits.least_speed < 0.0, jnp.minimum(turn, np.pi - turn), turn)
    sine, rounding = jnp.sin(turn), 4.0 * jnp.finfo(away.dtype).eps
    left = jnp.arcsin(jnp.clip(sine - far * bend + rounding, 0.0, 1.0))
    length = radius * (turn - left) + jnp.maximum(far - radius * sine, 0.0)
    turned = jnp.maximum(jnp.abs(wrap(case.end_heading - start)) - tolerance, 0.0) * radius
    longest = jnp.max(jnp.where(far > 0.0, length, 0.0))
    return jnp.maximum(longest, jnp.where(is_free, 0.0, turned))


def longest_drive(case: InterceptCase, times: Array) -> Array:
    """Return upper bounds (...) [m] of the distances that the car can drive until times (...)."""
    gained = 0.5 * jnp.minimum(case.limits.acceleration, 1e6) * times
    most = jnp.maximum(case.limits.speed, -case.limits.least_speed)
    return jnp.minimum(jnp.abs(case.speed) + gained, most) * times
