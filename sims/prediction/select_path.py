"""Prediction of a target's position in the plane, and of its error, from noisy observations.

[Qu2022, Section III-A] fits a polynomial (`polynomial_fit.py`) of a degree that the paper does not
report. `select` compares a straight line with a path of constant turn rate instead. The
functions `covariance` and `chance_within` estimate the error of its prediction. World frame in the
plane, SI units, one target; use `jax.vmap` for several. The noise is Gaussian, equal on both axes.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.typing import ArrayLike

from planner_jax.core.errors import ArgumentError
from planner_jax.plane.target import TurningPath, arc
from planner_jax.sims.prediction.observed import centre, safe_sqrt
from planner_jax.sims.prediction.turn_fit import best_turn, fit_rate, path_of, tangent

# Half width of the interval of evaluated turn rates, in standard deviations of the turn rate.
_REACH = 5.0
_OFFSETS = np.linspace(-1.0, 1.0, 49)  # evaluated turn rates, relative to that half width
# Nodes and weights of a Gauss-Legendre quadrature on (-1, 1).
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(24)


@struct.dataclass
class TurnPrior:
    """Prior knowledge about a target's turn rate before the first observation.

    A target moves straight, or turns left or right with equal probability, at a rate whose
    magnitude is log-normal. The default numbers are for targets of 0.2 to 0.5 m/s that turn at 0.03
    to 0.1 rad/s. Predictions of faster turns are hardly worse. Slower turns are mistaken for
    straight paths more often than the predicted errors state. For such targets use a wider prior,
    such as `TurnPrior(chance=0.5, typical=0.03, spread=1.0)`; it predicts straight paths less well.
    """

    chance: ArrayLike = 0.4  # (), probability that a target turns, between 0 and 1
    typical: ArrayLike = 0.065  # () [rad/s] > 0, median magnitude of the turn rate
    spread: ArrayLike = 0.4  # () > 0, standard deviation of the logarithm of the magnitude

    def log_density(self, rate: Array) -> Array:
        """Return the logarithm (...) of the prior density [s/rad] at turn rates (...) [rad/s]."""
        turns = rate != 0.0
        size = jnp.log(jnp.where(turns, jnp.abs(rate), 1.0))
        apart = (size - jnp.log(self.typical)) / self.spread
        density = -size - 0.5 * apart**2 - jnp.log(self.spread) - 0.5 * np.log(8.0 * np.pi)
        return jnp.where(turns, density, -jnp.inf)

    @property
    def variance(self) -> Array:
        """The variance of a turning target's turn rate, () [rad^2/s^2]."""
        return jnp.square(self.typical) * jnp.exp(2.0 * jnp.square(self.spread))


USUAL = TurnPrior()  # the default prior


@struct.dataclass
class Alternatives:
    """K paths with different turn rates and their probabilities; the first path is straight.

    Each path is fitted to the observations. With points as complex numbers, its position at time t
    is  centre + velocity g(t - middle).  Here g is the displacement of a target that starts with
    velocity 1 along x and turns at the path's rate, minus `lever`, the weighted mean of this
    displacement over the observations. The position error is Gaussian and equal on both axes, with
    variance  centre_variance + velocity_variance |g(t - middle)|^2.
    """

    chance: Array  # (K,), probability of each path; the sum is 1
    turn_rate: Array  # (K,) [rad/s], constant turn rate of each path
    velocity: Array  # (K, 2) [m/s], velocity of each path at the time `middle`
    lever: Array  # (K, 2) [s], weighted mean of the displacements at the times of observation
    centre: Array  # (2,) [m], weighted mean of the observations
    middle: Array  # () [s], weighted mean of the times of observation
    centre_variance: Array  # () [m^2], variance of a coordinate of `centre`
    velocity_variance: Array  # (K,) [m^2/s^2], variance of a velocity component


@struct.dataclass
class Prediction:
    """The predicted path of a target, with alternative paths that express the uncertainty."""

    path: TurningPath  # with turn rate 0 if it is straight
    is_turning: Array  # () bool, which of the two models was selected
    chance_turning: Array  # (), probability that the target turns
    # (), 2 log(L_turn / L_line): how much more likely the best turn makes the observations than the
    # best straight line; L_turn and L_line are the likelihoods of these two fits.
    gain: Array
    residual: Array  # () [m], root mean square of (observation - path), per coordinate
    noise: Array  # () [m], standard deviation of a coordinate, passed or estimated
    alternatives: Alternatives


def select(
    times: ArrayLike,
    positions: ArrayLike,
    noise: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    *,
    prior: TurnPrior = USUAL,
    threshold: ArrayLike | None = None,
    fastest: ArrayLike = 1.0,
) -> Prediction:
    """Predict a target: select a straight path or a path of constant turn rate.

    The posterior probability of every turn rate follows from Bayes' rule and quadrature over the
    rate. The prior of position and velocity is flat. The selected path has the median turn rate.
    The median is zero unless turns to one side are more probable than all other alternatives
    together. Weak turns are therefore shrunk towards zero, and the path does not jump as
    observations change (posterior median thresholding [Johnstone2004]). If `threshold` is passed,
    the path is instead the least-squares turn if 2 log(its likelihood / likelihood of the best
    line) exceeds the threshold, and else this line. The error estimates average over all rates.

    A residual far above the noise means that neither model fits the target. Do not trust such a
    prediction. With fewer than three observations, or four if the noise is estimated, the path is
    straight and the error is unbounded.

    Args:
        times: (L,) [s], times of L observations. Time 0 of the path should not be far from them.
        positions: (L, 2) [m], observed positions of the target.
        noise: () [m] > 0, standard deviation of a coordinate of an observation of weight 1. By
            default the noise is estimated from the residuals of the best turn.
        weights: (L,) >= 0, proportional to the inverse variance of each observation; 1 by default.
            An observation of weight zero, or not finite, is absent.
        prior: probability and rate of turns.
        threshold: (), the gain above which a target counts as turning. The gain is 2 log(likelihood
            of the best turn / likelihood of the best line). For a straight target it exceeds 6.6
            with a probability of 1 %.
        fastest: () [rad/s], greatest turn rate at which the search starts. At that rate the target
            should turn by at most 24 rad within the observations, and by less than pi between two.

    Raises:
        ValueError: the arrays hold too few observations, the shapes do not match, or the noise is
            not positive.
    """
    if isinstance(noise, int | float) and not noise > 0.0:
        raise ArgumentError("noise", "> 0", noise)
    least = 4 if noise is None else 3
    seen = centre(times, positions, weights, least)
    dtype = seen.after.dtype
    best = best_turn(seen, fastest)
    enough, freedom = seen.num >= least, jnp.maximum(2.0 * seen.num - 5.0, 3.0)
    if noise is None:
        extent = jnp.sum(seen.weight * (seen.place[0] ** 2 + seen.place[1] ** 2))
        rounding = (4.0 * jnp.finfo(dtype).eps) ** 2 * extent
        variance = jnp.maximum(best.squares / freedom, jnp.maximum(rounding, 1e-30))
        # With an estimated noise, errors have Student's distribution, which has this variance.
        error_variance = variance * freedom / (freedom - 2.0)
    else:
        variance = error_variance = jnp.square(jnp.asarray(noise, dtype))

    def gain(squares: Array) -> Array:
        excess = (squares - best.squares) / variance
        return excess if noise is not None else (freedom + 1.0) * jnp.log1p(excess / freedom)

    # Turn rates are evaluated around the best rate, which is shifted towards zero if the
    # observations determine it poorly.
    information = tangent(seen, best)[1] / variance
    precision = information + 1.0 / jnp.asarray(prior.variance, dtype)
    reach = _REACH / jnp.sqrt(precision)
    step = reach * (_OFFSETS[1] - _OFFSETS[0])
    rates = best.rate * information / precision + reach * jnp.asarray(_OFFSETS, dtype)
    fits = jax.vmap(fit_rate, in_axes=(None, 0))(seen, jnp.append(jnp.zeros((), dtype), rates))
    chance = jnp.asarray(prior.chance, dtype)
    of_turns = prior.log_density(rates) + jnp.log(step) + jnp.log(chance)
    log_prior = jnp.append(jnp.log1p(-chance), of_turns)
    power, gains = jnp.where(fits.power > 0.0, fits.power, 1.0), gain(fits.squares)
    likely = jax.nn.softmax(log_prior - 0.5 * gains - jnp.log(power))
    if threshold is None:
        rate = _median(rates, step, likely[1:], likely[0])
    else:
        rate = jnp.where(gains[0] > threshold, best.rate, 0.0)
    chosen = fit_rate(seen, jnp.where(enough, rate, 0.0))
    return Prediction(
        path=path_of(seen, chosen),
        is_turning=chosen.rate != 0.0,
        chance_turning=jnp.sum(likely[1:]),
        gain=gains[0],
        residual=safe_sqrt(chosen.squares / (2.0 * seen.total)),
        noise=jnp.sqrt(variance),
        alternatives=Alternatives(
            chance=likely,
            turn_rate=fits.rate,
            velocity=jnp.stack(fits.velocity, axis=-1),
            lever=jnp.stack(fits.lever, axis=-1),
            centre=jnp.stack(seen.centre),
            middle=seen.middle,
            centre_variance=jnp.where(enough, error_variance / seen.total, jnp.inf),
            velocity_variance=error_variance / power,
        ),
    )


def _median(rates: Array, step: Array, chance: Array, of_zero: Array) -> Array:
    below = jnp.cumsum(chance) - chance
    right = jnp.sum(jnp.where(rates < 0.0, chance, 0.0)) <= 0.5  # whether the median is >= 0
    level = jnp.where(right, 0.5 - of_zero, 0.5)
    wide = chance > jnp.finfo(chance.dtype).eps
    inside = jnp.clip((level - below) / jnp.where(wide, chance, 1.0), 0.0, 1.0)
    share = jnp.where(wide, inside, level > below)
    rate = rates[0] + step * (jnp.sum(share) - 0.5)
    return jnp.where(right, jnp.maximum(rate, 0.0), jnp.minimum(rate, 0.0))


def mean_position(prediction: Prediction, time: ArrayLike) -> Array:
    """Return the mean position (2,) [m] of the alternative paths, weighted by their probability."""
    offset, _ = _errors(prediction, time)
    mean = jnp.sum(prediction.alternatives.chance[:, None] * offset, axis=0)
    return prediction.path.at(jnp.asarray(time)).pos + mean


def covariance(prediction: Prediction, time: ArrayLike) -> Array:
    """Return the second moment (2, 2) [m^2] of the error of the path's position at a time () [s].

    The error is measured from the selected path, not from `mean_position`. The diagonal is infinite
    if there were too few observations.
    """
    offset, variance = _errors(prediction, time)
    chance = prediction.alternatives.chance
    apart = jnp.sum(chance[:, None, None] * offset[:, :, None] * offset[:, None, :], axis=0)
    alike = prediction.alternatives.centre_variance + jnp.sum(chance * variance)
    return apart + jnp.where(jnp.eye(2, dtype=bool), alike, 0.0)


def chance_within(prediction: Prediction, time: ArrayLike, radius: ArrayLike) -> Array:
    """Return the probability () that a target is within `radius` () [m] of its predicted position.

    The result is 0 if there were too few observations.
    """
    offset, variance = _errors(prediction, time)
    centre_variance = prediction.alternatives.centre_variance
    known = jnp.isfinite(centre_variance)
    std = jnp.sqrt(jnp.where(known, centre_variance + variance, 1.0))
    distance = safe_sqrt(jnp.sum(offset**2, axis=-1))
    inside = jax.vmap(_chance_in_circle, in_axes=(0, 0, None))(distance, std, jnp.asarray(radius))
    return jnp.sum(prediction.alternatives.chance * jnp.where(known, inside, 0.0))


def _errors(prediction: Prediction, time: ArrayLike) -> tuple[Array, Array]:
    among = prediction.alternatives
    time = jnp.asarray(time, among.middle.dtype)
    ahead, aside = arc(among.turn_rate, time - among.middle)
    ahead, aside = ahead - among.lever[:, 0], aside - among.lever[:, 1]
    x, y = among.velocity[:, 0], among.velocity[:, 1]
    way = jnp.stack([x * ahead - y * aside, x * aside + y * ahead], axis=-1)
    offset = (among.centre - prediction.path.at(time).pos)[None] + way
    return offset, among.velocity_variance * (ahead**2 + aside**2)


def _chance_in_circle(distance: Array, std: Array, radius: Array) -> Array:
    """Return the probability () that a Gaussian point lies in a circle at a distance from its mean.

    The circle is integrated in strips perpendicular to the line from the Gaussian's mean to its
    centre, at distances radius * sin(phi) from the centre. The quadrature is over phi, only where
    the Gaussian is not negligible.
    """

    def angle(along: Array) -> Array:
        within = jnp.abs(along) < 1.0
        inner = jnp.arcsin(jnp.where(within, along, 0.0))
        return jnp.where(within, inner, jnp.sign(along) * 0.5 * np.pi)

    safe = jnp.where(radius > 0.0, radius, 1.0)
    low, high = angle((distance - 7.0 * std) / safe), angle((distance + 7.0 * std) / safe)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    phi = middle + half * jnp.asarray(_NODE, distance.dtype)
    along, across = radius * jnp.sin(phi), radius * jnp.cos(phi)
    density = jnp.exp(-0.5 * ((along - distance) / std) ** 2) * across / std
    chords = density * lax.erf(across / (std * np.sqrt(2.0))) / np.sqrt(2.0 * np.pi)
    return half * jnp.sum(chords * jnp.asarray(_WEIGHT, distance.dtype))
