"""Motions of joints whose rates change evenly between equal knots.

A motion is given by its steps (K, 6) [rad]: the rates at the knots 1 to K times the duration T, so
that how far the joints turn does not depend on T. Angles are quadratic from knot to knot; rates are
greatest at knots, and accelerations constant in between, so that limits at knots are exact.
"""

import functools

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate


@functools.cache
def sums(pieces: int, shares: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """What steps add up to at shares of the duration.

    Returns:
        first: (N,), of the rates at the beginning, times the duration.
        steps: (N, K), of the steps.
    """
    place = np.asarray(shares)[:, None] * pieces
    knots = np.arange(pieces + 1)
    # The integral of a hat of height one around each knot, up to the place.
    left, right = np.clip(place - knots + 1.0, 0.0, 1.0), np.clip(place - knots, 0.0, 1.0)
    weights = 0.5 * left**2 + right - 0.5 * right**2
    weights[:, 0] -= 0.5
    weights /= pieces
    return weights[:, 0], weights[:, 1:]


def angles_at(start: Array, first: Array, steps: Array, shares: tuple[float, ...]) -> Array:
    """Angles (N, 6) [rad] at shares of the duration.

    Args:
        start: (6,) [rad].
        first: (6,) [rad], the rates at the beginning times the duration.
        steps: (K, 6) [rad].
        shares: N of them, in [0, 1].
    """
    of_first, of_steps = sums(steps.shape[0], shares)
    turned = jnp.matmul(jnp.asarray(of_steps, steps.dtype), steps, precision=lax.Precision.HIGHEST)
    return start + jnp.asarray(of_first, steps.dtype)[:, None] * first + turned


def polynomial(start: Array, first: Array, steps: Array, duration: Array) -> PiecewisePolynomial:
    """The same motion as a piecewise polynomial: K pieces of degree 2."""
    pieces = steps.shape[0]
    step = duration / pieces
    rates = jnp.concatenate([first[None], steps]) / jnp.maximum(duration, 1e-9)
    rise = (rates[1:] - rates[:-1]) / jnp.maximum(step, 1e-9)
    turned = step * 0.5 * (rates[1:] + rates[:-1])
    angles = start + jnp.cumsum(turned, axis=0) - turned
    return PiecewisePolynomial(
        coeffs=jnp.stack([angles, rates[:-1], 0.5 * rise], axis=1),
        durations=jnp.broadcast_to(step, (pieces,)),
    )


def quickened(
    motion: PiecewisePolynomial, velocity: Array, acceleration: Array
) -> tuple[PiecewisePolynomial, Array]:
    """A motion from rest to rest on the same way, as quick as limits allow, but no slower.

    Args:
        motion: of degree 2.
        velocity: (6,) [rad/s], the most.
        acceleration: (6,) [rad/s^2], the most.

    Returns:
        motion: the same, in time.
        pace: () in (0, 1], the share of the duration that it takes.
    """
    rates = motion.coeffs[:, 1] / velocity
    rises = 2.0 * motion.coeffs[:, 2] / acceleration
    pace = jnp.maximum(jnp.max(jnp.abs(rates)), jnp.sqrt(jnp.max(jnp.abs(rises))))
    pace = jnp.clip(pace, 1e-3, 1.0)
    return PiecewisePolynomial(
        coeffs=motion.coeffs / (pace ** jnp.arange(3))[:, None], durations=pace * motion.durations
    ), pace


def cut(motion: PiecewisePolynomial, time: Array) -> PiecewisePolynomial:
    """A motion up to a time () [s] since its start, or as a whole if it ends before.

    What is not begun by then lasts 0 s, and goes on from where the motion is cut.
    """
    starts = jnp.cumsum(motion.durations) - motion.durations
    last = jnp.minimum(time, jnp.sum(motion.durations))
    end = jnp.stack([evaluate(motion, last), evaluate(motion, last, 1)])
    rest = jnp.zeros_like(motion.coeffs[0]).at[:2].set(end)
    return PiecewisePolynomial(
        coeffs=jnp.where((starts >= time)[:, None, None], rest, motion.coeffs),
        durations=jnp.clip(time - starts, 0.0, motion.durations),
    )


@functools.cache
def profiles(pieces: int, ends_at_rest: bool) -> np.ndarray:
    """Shapes (P, K) of steps that turn a joint by one [rad] from rest, even ramps at either end.

    Ramps take a whole number of pieces: from one up to half of them, and up to all of them where
    the motion need not end at rest.
    """
    knots = np.arange(1, pieces + 1)
    found = []
    for ramp in range(1, (pieces // 2 if ends_at_rest else pieces) + 1):
        shape = np.minimum(knots / ramp, 1.0)
        if ends_at_rest:
            shape = np.minimum(shape, (pieces - knots) / ramp)
        rates = np.concatenate([[0.0], shape])
        found.append(shape * pieces / np.sum(0.5 * (rates[1:] + rates[:-1])))
    return np.array(found)
