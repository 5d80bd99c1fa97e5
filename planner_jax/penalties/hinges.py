"""Penalty functions of an excess, the integral of penalties over time, and the cost of time."""

import jax.numpy as jnp
from jax import Array

from planner_jax.cost.penalty import smooth_hinge as smooth_hinge
from planner_jax.cost.penalty import trapezoid_weights
from planner_jax.trajectory.minco import durations_of


def steep_hinge(x: Array, width: float | Array, printed: bool = True) -> Array:
    """Return the penalty L_eps(x) for eps = width > 0 [Yu2023catch, eq. 23].

    L_eps is 0 below 0, and x^3 from 0 to eps. Above eps it is eps^3 + (x - eps)^2 x / eps^4, as
    printed in the paper. The value is continuous at eps, but the slope drops from 3 eps^2 to 0.
    With `printed=False` the term 3 eps^2 (x - eps) is added above eps, so that the slope is
    continuous, too. `x` may have any shape.
    """
    inside = jnp.clip(x, 0.0, width)
    beyond = jnp.maximum(x - width, 0.0)
    value = inside**3 + beyond**2 * (beyond + width) / width**4 * (x > width).astype(x.dtype)
    return value if printed else value + 3.0 * width**2 * beyond


def trapezoid(values: Array, duration: Array) -> Array:
    """Return the integral () of a piece's penalties by the trapezoid rule [Yu2023catch, eq. 26a].

    `values` (K + 1,) are penalties at the ends of K equal intervals of `duration` [s].
    """
    weights = jnp.asarray(trapezoid_weights(values.shape[0] - 1).astype(values.dtype))
    return duration * jnp.sum(weights * values)


def time_cost(tau: Array, rho: float | Array) -> Array:
    """Return rho times the sum of the durations e^tau_i of pieces [Yu2023catch, eqs 20-21].

    `tau` (M,) are the logarithms of durations in seconds; `rho` is the cost of a second.
    """
    return rho * jnp.sum(durations_of(tau))
