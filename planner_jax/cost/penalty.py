"""Smooth penalties, the quadrature along a trajectory, and peaks between its samples."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.arithmetic import reciprocal


def smooth_hinge(x: Array, width: float | Array | Array) -> Array:
    """Return L_mu(x): 0 for x < 0, x - mu/2 for x > mu, a quartic between [Yu2023catch, eq. 27b].

    It is twice continuously differentiable. mu > 0 is the `width`.
    """
    # `where` is faster than `clip` and `maximum`, whose derivatives contain divisions.
    below = x < width
    inside = jnp.where(below, jnp.where(x > 0.0, x, 0.0), width)
    blend = (width - 0.5 * inside) * (inside * (1.0 / width)) ** 3
    return blend + jnp.where(below, 0.0, x - width)


def trapezoid_weights(num_intervals: int) -> np.ndarray:
    """Return the trapezoid rule's weights (1/2, 1, ..., 1, 1/2) / n for n intervals of [0, 1]."""
    weights = np.ones(num_intervals + 1)
    weights[[0, -1]] = 0.5
    return weights / num_intervals


def join_trapezoid_weights(
    num_intervals: int, proportions: np.ndarray | Sequence[float]
) -> np.ndarray:
    """Return trapezoid weights of consecutive pieces; neighbours share a node.

    The pieces have durations `proportions` (M,) and n = `num_intervals` intervals each; the result
    has the shape (M n + 1,).
    """
    weights = np.zeros(len(proportions) * num_intervals + 1)
    for i, share in enumerate(proportions):
        span = slice(i * num_intervals, (i + 1) * num_intervals + 1)
        weights[span] += share * trapezoid_weights(num_intervals)
    return weights


def greatest_by_parabolas(values: Array, times: np.ndarray) -> Array:
    """Return the maximum () of K samples and of the parabolas through each three neighbours.

    For a smooth quantity the error is of third order in the step. `times` (K,) are in any unit.
    """
    import chex  # only where a function is traced, as its import takes a tenth of a second

    chex.assert_equal_shape([values, times])
    chex.assert_rank(values, 1)
    before, after = np.diff(times)[:-1], np.diff(times)[1:]
    rise = peak_above(values[:-2], values[1:-1], values[2:], before, after)
    return jnp.max(values + jnp.pad(rise, 1))


def peak_above(
    left: Array, middle: Array, right: Array, before: Array | np.ndarray, after: Array | np.ndarray
) -> Array:
    """Return how high () the parabola through three samples rises above the middle sample.

    It is 0 if the parabola has no peak between the outer samples, and at most half of the samples'
    range. The times from left to middle and from middle to right sample are `before` and `after`.
    """
    rising, falling = (middle - left) / before, (middle - right) / after
    bend, turn = rising + falling, after * rising - before * falling
    # The parabola's peak is at the time `turn / (2 bend)` after the middle sample.
    there = (bend > 0.0) & (turn <= 2.0 * after * bend) & (-turn <= 2.0 * before * bend)
    turn, bend = jnp.where(there, turn, 0.0), jnp.where(there, bend, 1.0)
    return turn * turn * reciprocal(4.0 * (before + after) * bend)


def greatest_by_tangents(values: Array, slopes: Array, step: Array) -> Array:
    """Return the maximum () of K samples and of intersections of neighbouring tangents.

    `slopes` (K,) are time derivatives, and samples are a time `step` apart. The result is never
    below the true peak if the quantity is concave between samples.
    """
    import chex  # as above

    chex.assert_equal_shape([values, slopes])
    chex.assert_rank([values, step], [1, 0])
    first, second = values[:-1], values[1:]
    bend = slopes[:-1] - slopes[1:]
    # The tangents intersect at `place / bend` after the first sample.
    place = second - first - slopes[1:] * step
    there = (bend > 0.0) & (place > 0.0) & (place < bend * step)
    place, bend = jnp.where(there, place, 0.0), jnp.where(there, bend, 1.0)
    return jnp.maximum(jnp.max(values), jnp.max(first + slopes[:-1] * place / bend))


def apex_excess(apex: Array, min_apex: Array, max_apex: Array) -> Array:
    """Return relative excesses 1 - H / H_min, H / H_max - 1 of the apex H [Yu2023bat, eq. 21]."""
    return jnp.stack([1.0 - apex * reciprocal(min_apex), apex * reciprocal(max_apex) - 1.0])


def hitting_speed_excess(vel: Array, limit: Array) -> Array:
    """Return v_j^2 / v_max,j^2 - 1, (3,), of velocity v and limit v_max [Yu2023bat, eq. 24a]."""
    return (vel * reciprocal(limit)) ** 2 - 1.0
