"""Joint motions of an arm whose rates are linear in time between equidistant knots.

A motion has K pieces. Its parameters are the steps (K, n) [rad]: the joint rates at the ends of the
pieces, multiplied by the duration. The angles then do not depend on the duration. They are
quadratic in time between knots. Rates have their extremes at knots, and accelerations are constant
between knots, so that checks at the knots suffice for the limits of both.
"""

import functools

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.robot.arm_dynamics import stretch
from planner_jax.trajectory.polynomial import PiecewisePolynomial


@functools.cache
def step_weights(pieces: int, shares: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return weights of a motion's parameters in sums that are the angles turned up to N times.

    The parameters are a joint's rates, multiplied by the duration, at the start and at the ends of
    K = `pieces` pieces. The times are `shares`, from 0 to 1, of the duration.

    Returns:
        first: (N,), weights of the parameter at the start.
        steps: (N, K), weights of the parameters at the ends of the pieces.
    """
    position = np.asarray(shares)[:, None] * pieces
    knots = np.arange(pieces + 1)
    # Integrals of the knots' hat functions (1 at a knot, 0 at others) from the start to `position`.
    left, right = np.clip(position - knots + 1.0, 0.0, 1.0), np.clip(position - knots, 0.0, 1.0)
    weights = 0.5 * left**2 + right - 0.5 * right**2
    weights[:, 0] -= 0.5
    weights /= pieces
    return weights[:, 0], weights[:, 1:]


def angles_at(start: Array, first: Array, steps: Array, shares: tuple[float, ...]) -> Array:
    """Return the joint angles (N, n) [rad] of a motion at N times: `shares` of its duration.

    The motion has K pieces and the initial angles `start` (n,) [rad]. The initial rates are `first`
    (n,), and the rates after each piece `steps` (K, n), both multiplied by the duration [rad].
    """
    of_first, of_steps = step_weights(steps.shape[0], shares)
    turned = jnp.matmul(jnp.asarray(of_steps, steps.dtype), steps, precision=lax.Precision.HIGHEST)
    return start[None] + jnp.asarray(of_first, steps.dtype)[:, None] * first[None] + turned


def bump_steps(height: Array, pieces: int) -> Array:
    """Return offsets (K, n) [rad] of a motion's parameters that add a detour to its joint angles.

    The detour height sin^2(pi s), with time s as a fraction of the duration, reaches `height` (n,)
    [rad] at half of the duration and ends at zero. The offsets are its rates at the ends of the
    K = `pieces` pieces, multiplied by the duration: pi height sin(2 pi s).
    """
    knots = np.arange(1, pieces + 1) / pieces
    return jnp.asarray(np.pi * np.sin(2.0 * np.pi * knots), height.dtype)[:, None] * height[None]


def polynomial(start: Array, first: Array, steps: Array, duration: Array) -> PiecewisePolynomial:
    """Convert a motion of `duration` [s] to K polynomial pieces of degree 2.

    The joint angles start at `start` (n,) [rad]. The joint rates at the start are `first` (n,), and
    at the ends of the pieces `steps` (K, n), both multiplied by the duration [rad].
    """
    pieces = steps.shape[0]
    step = duration / pieces
    rates = jnp.concatenate([first[None], steps]) / jnp.maximum(duration, 1e-9)
    rise = (rates[1:] - rates[:-1]) / jnp.maximum(step, 1e-9)
    turned = step * 0.5 * (rates[1:] + rates[:-1])
    angles = start[None] + jnp.cumsum(turned, axis=0) - turned
    return PiecewisePolynomial(
        coeffs=jnp.stack([angles, rates[:-1], 0.5 * rise], axis=1),
        durations=jnp.broadcast_to(step, (pieces,)),
    )


def speed_up(
    motion: PiecewisePolynomial, velocity: Array, acceleration: Array
) -> tuple[PiecewisePolynomial, Array]:
    """Shorten the duration of a motion along its path until a joint reaches one of its limits.

    The motion is piecewise quadratic, from rest to rest; the limits are (n,) [rad/s], [rad/s^2].

    Returns:
        motion: the motion with the same path and the shorter duration.
        pace: () in (0, 1], new duration divided by the old duration.
    """
    rates = motion.coeffs[:, 1] / velocity[None]
    rises = 2.0 * motion.coeffs[:, 2] / acceleration[None]
    pace = jnp.maximum(jnp.max(jnp.abs(rates)), jnp.sqrt(jnp.max(jnp.abs(rises))))
    pace = jnp.clip(pace, 1e-3, 1.0)
    return stretch(motion, pace), pace


def least_times(
    away: Array, rate: Array, velocity: Array, acceleration: Array, ends_at_rest: Array | bool
) -> tuple[Array, Array]:
    """Return the least times (n,) [s] in which each joint alone turns by `away` (n,) [rad].

    A joint starts with the rate (n,) [rad/s], and may end at rest. The motion has the greatest
    acceleration, then the greatest rate, and then the greatest deceleration. The second result is
    the duration (n,) of the acceleration.
    """
    stop = jnp.where(ends_at_rest, 0.5 * rate * jnp.abs(rate) / acceleration, 0.0)
    sign = jnp.where(away >= stop, 1.0, -1.0)
    away, rate = sign * away, sign * rate
    halves = jnp.where(ends_at_rest, 2.0, 1.0)
    # Rate at which the joint stops to accelerate: it reaches `away` at rest, or with this rate.
    square = (2.0 * acceleration * away + rate**2) / halves
    moves = square > 0.0  # the root has a finite slope at standstill
    peak = jnp.minimum(jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1.0)), 0.0), velocity)
    turned = (halves * peak**2 - rate**2) / (2.0 * acceleration)
    cruise = jnp.maximum(away - turned, 0.0) / jnp.maximum(peak, 1e-9)
    return (halves * peak - rate) / acceleration + cruise, (peak - rate) / acceleration


@functools.cache
def profiles(pieces: int, ends_at_rest: bool) -> np.ndarray:
    """Return P speed profiles (P, K), which turn a joint by 1 rad from standstill.

    A profile has the joint's rates at the ends of K = `pieces` pieces, times the duration [rad].

    The rate rises linearly, is then constant and, with `ends_at_rest`, falls linearly to zero. The
    ramps last 1 to K / 2 pieces, or 1 to K pieces without `ends_at_rest`. In the last profile the
    rate is a parabola, whose mean square acceleration is least.
    """
    knots = np.arange(1, pieces + 1)
    shapes = []
    for ramp in range(1, (pieces // 2 if ends_at_rest else pieces) + 1):
        shape = np.minimum(knots / ramp, 1.0)
        shapes.append(np.minimum(shape, (pieces - knots) / ramp) if ends_at_rest else shape)
    shapes.append(knots * ((1 if ends_at_rest else 2) * pieces - knots))
    means = [np.sum(shape) - 0.5 * shape[-1] for shape in shapes]
    return np.array([shape * pieces / mean for shape, mean in zip(shapes, means, strict=True)])
