"""Paths of constant speed and turn rate through observations of a target.

With points as complex numbers, such a path is  position + velocity g(t)  at time t, with the arc
g(t) = (exp(i w t) - 1) / (i w)  for the turn rate w. At a given w, position and velocity follow in
closed form by linear least squares; only w is searched for (variable projection). In this module a
complex number is a pair of arrays.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from planner_jax.plane.target import TurningPath, arc
from planner_jax.sims.prediction.observed import Centred, Pair

_RATES = 33  # number of equally spaced turn rates among which the search selects its start
# [rad/s], greatest turn rate at which the search starts. At that rate a target should turn by at
# most 24 rad within the observations, and by less than pi between two.
_FASTEST = 1.0
_STEPS = 8  # number of Gauss-Newton iterations, over the turn rate alone


class TurnFit(NamedTuple):
    """The path of one turn rate that fits L observations of a target best."""

    rate: Array  # () [rad/s], turn rate
    velocity: Pair  # each () [m/s], at the mean time of the observations
    lever: Pair  # each () [s], weighted mean of the arcs g at the times of observation
    power: Array  # () [s^2], weighted sum of |arc - lever|^2
    residual: Pair  # each (L,) [m], observations minus the path
    squares: Array  # () [m^2], weighted sum of |residual|^2


def fit_rate(seen: Centred, rate: Array) -> TurnFit:
    """Fit a path's position and velocity to observations for a turn rate () [rad/s]."""
    arcs = arc(rate, seen.after)
    lever = _mean(seen, arcs)
    arm = _minus(arcs, lever)
    power = _sum(seen, arm, arm)
    velocity = _share(seen, arm, power, seen.place)
    residual = _minus(seen.place, _times(velocity, arm))
    return TurnFit(rate, velocity, lever, power, residual, _sum(seen, residual, residual))


def tangent(seen: Centred, fit: TurnFit) -> tuple[Callable[[Array], Pair], Array]:
    """Return the derivative of the fitted path by the turn rate, as a function of time.

    The derivative includes the change of the fitted position and velocity.

    Returns:
        slope: function from times (...) [s] after the mean time to derivatives, each (...) [m
            s/rad].
        information: () [m^2 s^2/rad^2], weighted sum of the squared slopes at the observations.
    """

    def differentiate_arcs(after: Array) -> tuple[Pair, Pair]:
        one = jnp.ones_like(fit.rate)
        arcs, slopes = jax.jvp(lambda rate: arc(rate, after), (fit.rate,), (one,))
        return arcs, _times(fit.velocity, slopes)

    arcs, moved = differentiate_arcs(seen.after)
    mean = _mean(seen, moved)
    follows = _share(seen, _minus(arcs, fit.lever), fit.power, moved)

    def subtract_fit(arcs: Pair, moved: Pair) -> Pair:
        return _minus(_minus(moved, mean), _times(follows, _minus(arcs, fit.lever)))

    of_seen = subtract_fit(arcs, moved)
    return lambda after: subtract_fit(*differentiate_arcs(after)), _sum(seen, of_seen, of_seen)


def best_turn(seen: Centred) -> TurnFit:
    """Fit position, velocity and turn rate to observations by least squares.

    Gauss-Newton refines the best of 33 equally spaced rates. The path is straight if fewer than
    three observations are present. JAX can differentiate the result by the observations. The
    derivatives are exact at the optimum, since the search for the turn rate is not differentiated.
    """

    def downhill(rate: Array) -> Array:
        fit = fit_rate(seen, rate)
        _, slopes = jax.jvp(lambda rate: arc(rate, seen.after), (rate,), (jnp.ones_like(rate),))
        return _sum(seen, _times(fit.velocity, slopes), fit.residual)

    spacing = jnp.asarray(_FASTEST, seen.after.dtype) * (2.0 / (_RATES - 1))
    rate = lax.stop_gradient(_search_rate(lax.stop_gradient(seen), spacing))
    # The search itself is not differentiated. A Newton step from a point of zero slope has the
    # derivatives of the optimum (implicit function theorem); its curvature is treated as constant.
    slope, curvature = jax.jvp(downhill, (rate,), (jnp.ones_like(rate),))
    curved = (curvature < 0.0) & (seen.num >= 3)
    step = slope / lax.stop_gradient(jnp.where(curved, curvature, -1.0))
    return fit_rate(seen, rate - jnp.where(curved, jnp.clip(step, -spacing, spacing), 0.0))


def _search_rate(seen: Centred, spacing: Array) -> Array:
    rates = spacing * (jnp.arange(_RATES) - _RATES // 2)
    squares = jax.vmap(lambda rate: fit_rate(seen, rate).squares)(rates)

    def refine(k: Array, rate: Array) -> Array:
        fit = fit_rate(seen, rate)
        slope, information = tangent(seen, fit)
        step = _sum(seen, slope(seen.after), fit.residual)
        step = step / jnp.where(information > 0.0, information, 1.0)
        most = spacing * 0.5 ** (k + 1)
        return rate + jnp.clip(step, -most, most)

    best = rates[jnp.argmin(squares)]
    return jnp.where(seen.num >= 3, lax.fori_loop(0, _STEPS, refine, best), 0.0)


def path_of(seen: Centred, fit: TurnFit) -> TurningPath:
    """Return the path of a fit, with times from time 0 instead of the observations' mean time."""
    place = jnp.stack(_minus(seen.centre, _times(fit.velocity, fit.lever)))
    start = TurningPath(place, jnp.stack(fit.velocity), fit.rate).at(-seen.middle)
    return TurningPath(start.pos, start.vel, fit.rate)


def _minus(a: Pair, b: Pair) -> Pair:
    return a[0] - b[0], a[1] - b[1]


def _times(a: Pair, b: Pair) -> Pair:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _sum(seen: Centred, a: Pair, b: Pair) -> Array:
    return jnp.sum(seen.weight * (a[0] * b[0] + a[1] * b[1]))


def _mean(seen: Centred, a: Pair) -> Pair:
    x, y = (jnp.sum(seen.weight * each) / seen.total for each in a)
    return x, y


def _share(seen: Centred, arm: Pair, power: Array, a: Pair) -> Pair:
    safe = jnp.where(power > 0.0, power, 1.0)
    return _sum(seen, arm, a) / safe, _sum(seen, (-arm[1], arm[0]), a) / safe
