"""Motions of an arm from standstill to standstill, with joint rates that are linear between knots.

Motions without obstacles and motions that stop at corners have a closed form.
"""

import jax.numpy as jnp
from jax import Array, lax

from planner_jax.robot.arm import ArmLimits
from planner_jax.robot.arm_motion import least_times
from planner_jax.trajectory.polynomial import PiecewisePolynomial


def join_knots(start: Array, durations: Array, rates: Array) -> PiecewisePolynomial:
    """Return the motion from `start` with M pieces (M,) [s] and joint rates (M + 1, n) at knots."""
    turned = 0.5 * durations[:, None] * (rates[1:] + rates[:-1])
    angles = start[None] + jnp.cumsum(turned, axis=0) - turned
    rise = jnp.diff(rates, axis=0) / jnp.where(durations > 0.0, durations, jnp.inf)[:, None]
    return PiecewisePolynomial(jnp.stack([angles, rates[:-1], 0.5 * rise], axis=1), durations)


def pad_knots(durations: Array, rates: Array, pieces: int) -> tuple[Array, Array]:
    """Append pieces without duration, so that a motion has as many pieces as `pieces`."""
    missing = pieces - durations.shape[0]
    return jnp.pad(durations, (0, missing)), jnp.pad(rates, ((0, missing), (0, 0)))


def quickest_knots(start: Array, goal: Array, limits: ArmLimits) -> tuple[Array, Array]:
    """Return the knots of the motion in which every joint takes the time of the slowest joint.

    No motion to the goal is shorter. A joint accelerates at its limit, turns at a constant rate,
    and brakes at its limit. The motion has 2 n + 1 pieces.

    Returns:
        durations: (2 n + 1,) [s].
        rates: (2 n + 2, n) [rad/s].
    """
    turn, most = goal - start, limits.acceleration
    size = jnp.abs(turn)
    still = jnp.zeros_like(size)
    total = jnp.max(least_times(size, still, limits.velocity, most, ends_at_rest=True)[0])
    speed = most * total
    square = speed**2 - 4.0 * most * size
    cruises = square > 0.0  # the root has a finite slope for the slowest joint
    root = jnp.where(cruises, jnp.sqrt(jnp.where(cruises, square, 1.0)), 0.0)
    speed = 0.5 * (speed - root)
    speed = jnp.minimum(speed, limits.velocity)
    ramps = speed / most
    times = jnp.sort(jnp.concatenate([jnp.zeros(1, turn.dtype), ramps, total - ramps, total[None]]))
    rise = most[None] * jnp.minimum(times, total - times)[:, None]
    rates = jnp.sign(turn)[None] * jnp.minimum(jnp.maximum(rise, 0.0), speed[None])
    return jnp.diff(times), rates


def straight_knots(points: Array, limits: ArmLimits) -> tuple[Array, Array]:
    """Return the knots of a motion along straight joint motions that stops at every point.

    Between points (N, n) [rad] the motion has 3 pieces, as short as the limits allow.

    Returns:
        durations: (3 N - 3,) [s].
        rates: (3 N - 2, n) [rad/s].
    """
    turn = jnp.diff(points, axis=0)
    size = jnp.maximum(jnp.abs(turn), 1e-9)
    speed, rise = (
        jnp.min(limit[None] / size, axis=1) for limit in (limits.velocity, limits.acceleration)
    )
    one, still = jnp.ones_like(speed), jnp.zeros_like(speed)
    total, ramp = least_times(one, still, speed, rise, ends_at_rest=True)
    moves = jnp.max(jnp.abs(turn), axis=1) > 0.0
    total, ramp = jnp.where(moves, total, 0.0), jnp.where(moves, ramp, 0.0)
    durations = jnp.stack([ramp, total - 2.0 * ramp, ramp], axis=1).reshape(-1)
    fast = turn / jnp.where(moves, total - ramp, 1.0)[:, None]
    rates = jnp.stack([fast, fast, jnp.zeros_like(fast)], axis=1).reshape(-1, points.shape[1])
    zero = jnp.zeros((1, points.shape[1]), points.dtype)
    return jnp.maximum(durations, 0.0), jnp.concatenate([zero, rates])


def stop_at_corners(path: Array, limits: ArmLimits, pieces: int) -> tuple[Array, Array]:
    """Return the knots of a motion along a path (N, n) [rad] that stops at its corners.

    The motion has `pieces` pieces. The rates are NaN if the path has too many corners for them.
    """
    line = jnp.diff(path, axis=0)
    length = jnp.sqrt(jnp.sum(line**2, axis=1))
    unit = line / jnp.maximum(length, 1e-9)[:, None]

    # A corner is a point after which the direction changes. Successive points may be equal.
    def turn(last: Array, each: tuple[Array, Array]) -> tuple[Array, Array]:
        unit, length = each
        moves = length > 1e-6
        return jnp.where(moves, unit, last), moves & (jnp.sum(last * unit) < 1.0 - 1e-6)

    _, bends = lax.scan(turn, unit[jnp.argmax(length > 1e-6)], (unit, length))
    most = pieces // 3  # of straight lines
    corners = jnp.nonzero(bends, size=most, fill_value=path.shape[0] - 1)[0]
    points = jnp.concatenate([path[:1], path[corners]])
    knots = pad_knots(*straight_knots(points, limits), pieces)
    fits = jnp.sum(bends, dtype=jnp.int32) < most
    return knots[0], jnp.where(fits, knots[1], jnp.nan)
