"""Smooth penalties, the quadrature along a trajectory, and peaks between its samples."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.arithmetic import reciprocal


def smoothed_hinge(x: Array, width: float | Array | Array) -> Array:
    """L_mu: zero below 0, linear above mu, a quartic blend between [Yu2023catch, eq. 27b].

    Twice continuously differentiable. x - mu/2 above the blend.

    Args:
        x: (...) violation, in the unit of the constraint.
        width: mu > 0.
    """
    # The slopes of `clip` and `maximum` divide; those of `where` do not, which is quicker.
    below = x < width
    inside = jnp.where(below, jnp.where(x > 0.0, x, 0.0), width)
    blend = (width - 0.5 * inside) * (inside * (1.0 / width)) ** 3
    return blend + jnp.where(below, 0.0, x - width)


def steep_hinge(x: Array, width: float | Array | Array) -> Array:
    """L_eps: cubic up to eps, then a far steeper cubic [Yu2023catch, eq. 23].

    eps^3 + (x - eps)^2 x / eps^4 above eps, as printed: the value is continuous there, but
    the slope drops from 3 eps^2 to 0 and grows again.

    Args:
        x: (...) violation.
        width: eps > 0.
    """
    inside = jnp.clip(x, 0.0, width)
    beyond = jnp.maximum(x - width, 0.0)
    return inside**3 + beyond**2 * (beyond + width) / width**4 * (x > width)


def trapezoid_weights(num_intervals: int) -> np.ndarray:
    """Weights (1/2, 1, ..., 1, 1/2) / n of the trapezoid rule on [0, 1] [Yu2023catch, eq. 26a].

    Returns:
        (num_intervals + 1,) float64, which sum to one.
    """
    weights = np.ones(num_intervals + 1)
    weights[[0, -1]] = 0.5
    return weights / num_intervals


def joined_trapezoid_weights(
    num_intervals: int, proportions: np.ndarray | Sequence[float]
) -> np.ndarray:
    """Trapezoid weights of pieces whose shared ends are sampled once.

    Args:
        num_intervals: of every piece.
        proportions: (M,) durations of the pieces in some unit.

    Returns:
        (M * num_intervals + 1,) float64; multiply by that unit [s].
    """
    weights = np.zeros(len(proportions) * num_intervals + 1)
    for i, share in enumerate(proportions):
        span = slice(i * num_intervals, (i + 1) * num_intervals + 1)
        weights[span] += share * trapezoid_weights(num_intervals)
    return weights


def greatest_by_parabolas(values: Array, times: np.ndarray) -> Array:
    """The greatest of samples (K,), and of the peaks of parabolas through three neighbours, ().

    Of a smooth quantity it misses the true peak by the cube of the samples' distance.

    Args:
        values: of K >= 3 samples.
        times: (K,) of the samples, in any unit, rising.
    """
    before, after = np.diff(times)[:-1], np.diff(times)[1:]
    rise = crest(values[:-2], values[1:-1], values[2:], before, after)
    return jnp.max(values + jnp.pad(rise, 1))


def crest(
    left: Array, middle: Array, right: Array, before: Array | np.ndarray, after: Array | np.ndarray
) -> Array:
    """By how much the peak of the parabola through three samples is above the middle one, >= 0.

    Zero where the parabola has no peak between the outer two. A peak that is there is above the
    middle sample by no more than half of what the samples differ.

    Args:
        left: (...), and so are the next two.
        middle: of the same quantity, later.
        right: later still.
        before: (...) time from the left to the middle one, > 0.
        after: (...) time from the middle to the right one, > 0, in the same unit.
    """
    rising, falling = (middle - left) / before, (middle - right) / after
    bend, turn = rising + falling, after * rising - before * falling
    # The peak is `turn / (2 bend)` after the middle.
    there = (bend > 0.0) & (turn <= 2.0 * after * bend) & (-turn <= 2.0 * before * bend)
    turn, bend = jnp.where(there, turn, 0.0), jnp.where(there, bend, 1.0)
    return turn * turn * reciprocal(4.0 * (before + after) * bend)


def greatest_by_tangents(values: Array, slopes: Array, step: Array) -> Array:
    """The greatest of samples (K,), and of where the tangents of two neighbours meet, ().

    Where a quantity is concave between samples this is never below its true peak, and where it is
    made of two lines, as that of a way past an edge is, it is the peak.

    Args:
        values: of K >= 2 samples.
        slopes: (K,) their derivatives by time.
        step: () between two samples.
    """
    first, second = values[:-1], values[1:]
    bend = slopes[:-1] - slopes[1:]
    # The tangents meet this long after the first sample, times the bend.
    place = second - first - slopes[1:] * step
    there = (bend > 0.0) & (place > 0.0) & (place < bend * step)
    place, bend = jnp.where(there, place, 0.0), jnp.where(there, bend, 1.0)
    return jnp.maximum(jnp.max(values), jnp.max(first + slopes[:-1] * place / bend))
