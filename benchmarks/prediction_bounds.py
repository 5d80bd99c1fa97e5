"""Cramer-Rao bounds: the smallest errors of unbiased predictions of a target's position.

The target moves in a plane, is observed with noise, and is predicted to a later time. Benchmarks of
interceptions compare the errors of this library's predictions with the bounds.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from planner_jax.plane.target import TurningPath, arc
from planner_jax.sims.prediction.observed import centre
from planner_jax.sims.prediction.turn_fit import fit_rate, tangent


def cramer_rao(
    path: TurningPath, times: ArrayLike, noise: ArrayLike, time: ArrayLike, *, turning: bool = True
) -> Array:
    """Return the least covariance (2, 2) [m^2] of an unbiased prediction of a position at one time.

    This is the inverse of the exact Fisher information of position, velocity and turn rate,
    propagated to the predicted position by its derivatives.

    Args:
        path: true path of the target.
        times: (L,) [s], times of the observations.
        noise: () [m], standard deviation of each observed coordinate.
        time: () [s], time for which the position is predicted.
        turning: whether the turn rate is unknown, too. False if the path is known to be straight.

    Raises:
        ValueError: there are fewer than two observations, or three with a turn rate.
    """
    times = jnp.asarray(times)
    seen = centre(times, jnp.zeros((*times.shape, 2)), None, 3 if turning else 2)
    velocity = path.at(seen.middle).vel
    fit = fit_rate(seen, path.turn_rate)._replace(velocity=(velocity[0], velocity[1]))
    variance = jnp.square(jnp.asarray(noise, seen.after.dtype))
    after = jnp.asarray(time) - seen.middle
    moves = zip(arc(path.turn_rate, after), fit.lever, strict=True)
    ahead, aside = (to - lever for to, lever in moves)
    shared = variance * (1.0 / seen.total + (ahead**2 + aside**2) / fit.power)
    bound = shared * jnp.eye(2, dtype=shared.dtype)
    if turning:
        slope, information = tangent(seen, fit)
        moved = jnp.stack(slope(after))
        bound += variance / information * moved[:, None] * moved[None]
    return bound


def mean_distance(bound: Array) -> Array:
    """Return the mean length () [m] of a Gaussian error with covariance `bound` (2, 2) [m^2]."""
    return np.sqrt(0.5 * np.pi) * jnp.mean(_safe_sqrt(_square_radii(bound)))


def share_within(bound: Array, radius: ArrayLike) -> Array:
    """Return the probability () that a Gaussian error is shorter than a radius [m].

    `bound` (2, 2) [m^2] is the covariance of the error, which has zero mean.
    """
    return 1.0 - jnp.mean(jnp.exp(-0.5 * radius**2 / _square_radii(bound)))


def _square_radii(bound: Array) -> Array:
    """Return squared distances (64,) [m^2] of points on the error ellipse from its centre.

    The ellipse belongs to one standard deviation of a Gaussian error with covariance `bound`. The
    points are at equal steps of the ellipse's parameter angle over half a turn. Callers average a
    function over the points, which is its mean over all directions of the error.
    """
    mean = 0.5 * (bound[0, 0] + bound[1, 1])
    apart = _safe_sqrt((0.5 * (bound[0, 0] - bound[1, 1])) ** 2 + bound[0, 1] ** 2)
    return mean + apart * jnp.asarray(np.cos(np.arange(64) * (np.pi / 32.0)), bound.dtype)


def _safe_sqrt(value: Array) -> Array:
    """Return the square roots of numbers (...) >= 0, with a derivative of zero at zero."""
    positive = value > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1.0)), 0.0)
