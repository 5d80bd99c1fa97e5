"""Smooth penalty shapes and the quadrature that sums them along a trajectory."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array


def smoothed_hinge(x: Array, width: float | Array) -> Array:
    """L_mu: zero below 0, linear above mu, a quartic blend between (paper 000, eq. 27b).

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


def steep_hinge(x: Array, width: float | Array) -> Array:
    """L_eps: cubic up to eps, then a far steeper cubic (paper 000, eq. 23).

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
    """Weights (1/2, 1, ..., 1, 1/2) / n of the trapezoid rule on [0, 1] (paper 000, eq. 26a).

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
