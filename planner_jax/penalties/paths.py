"""Costs of a car's path, of its station over time, and of an arm's spline."""

import jax.numpy as jnp
from jax import Array, lax

from planner_jax.trajectory.bezier import energy_of_pieces

WEIGHTS = 1.0, 0.1  # [1/s], [1/rad], of the duration and the length in `spline_cost`


def obstacle_cost(
    distances: Array, reach: float | Array, unit: float | Array = 1.0, printed: bool = False
) -> Array:
    """Return the cost () of the distances (n,) [m] of a path's points from the nearest obstacle.

    The cost is the sum of the squares of (reach - distance) / unit over the points nearer than
    `reach` [m], by [Qu2022, eq. 13]. The printed sum also counts the points farther away.
    """
    close = (reach - distances) / unit
    return jnp.sum((close if printed else jnp.maximum(close, 0.0)) ** 2)


def curvature_cost(
    points: Array, curvature: Array, unit: float | Array = 1.0, printed: bool = False
) -> Array:
    """Return the cost () of the curvature of a path above its limit [Qu2022, eq. 14].

    Args:
        points: (n + 1, 2) [m], points of the path. The curvature at an inner point is the angle
            between two steps, over the length of the first step.
        curvature: () [1/m], greatest curvature.
        unit: () [m], unit of length in which the cost is computed.
        printed: whether to return the sum of differences as printed, which has no minimum, instead
            of the sum of the squares of positive differences.
    """
    steps = (points[1:] - points[:-1]) / unit
    before, after = steps[:-1], steps[1:]
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    dot, squared = jnp.sum(before * after, axis=1), jnp.sum(before**2, axis=1)
    moving = squared * jnp.sum(after**2, axis=1) > 0.0
    turn = jnp.abs(jnp.arctan2(jnp.where(moving, cross, 0.0), jnp.where(moving, dot, 1.0)))
    excess = turn / jnp.sqrt(jnp.where(moving, squared, 1.0)) - curvature * unit
    return jnp.sum(excess if printed else jnp.maximum(excess, 0.0) ** 2)


def smoothness_cost(points: Array, unit: float | Array = 1.0) -> Array:
    """Return the sum () of the squared differences of neighbouring steps [Qu2022, eq. 15].

    `points` (n + 1, 2) [m] are points of a path; `unit` [m] is the unit of length of the cost.
    """
    steps = (points[1:] - points[:-1]) / unit
    return jnp.sum((steps[1:] - steps[:-1]) ** 2)


def speed_energy(points: Array, horizon: Array) -> Array:
    """Return the integral () [m^2/s^3] of a curve's squared acceleration [Qu2022, eq. 19].

    `points` (K, n + 1) [m] are the control points of K Bezier pieces of equal duration, which last
    `horizon` [s] together.
    """
    pieces, size = points.shape
    form = jnp.asarray(energy_of_pieces(size - 1, 2, pieces).astype(points.dtype))
    flat = points.reshape(-1)
    by_points = jnp.matmul(form, flat, precision=lax.Precision.HIGHEST)
    return jnp.sum(flat * by_points) / horizon**3


def end_error(points: Array, station: Array) -> Array:
    """Return the squared distance () [m^2] of a curve's end from a station [Qu2022, eq. 19].

    `points` (K, n + 1) [m] are the control points of the curve's K Bezier pieces.
    """
    return (points[-1, -1] - station) ** 2


def polyline_length(samples: Array) -> Array:
    """Return the length () of the polyline through samples (S, D), such as joint angles [rad]."""
    steps = jnp.sum(jnp.diff(samples, axis=0) ** 2, axis=1)
    return jnp.sum(jnp.sqrt(jnp.maximum(steps, 1e-10)))


def spline_cost(length: Array, duration: Array, weights: Array | tuple = WEIGHTS) -> Array:
    """Return w_1 (duration) + w_2 (length) of an arm's motion, (...) [Natarajan2024, eq. 4a].

    The length [rad] is the integral of the joint velocity's norm; `polyline_length` computes it
    from samples of the joint angles. The duration is in s, and w_1 and w_2 are the `weights` (2,).
    """
    return weights[0] * duration + weights[1] * length
