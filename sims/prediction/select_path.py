"""Prediction of a target's path in the plane from noisy observations.

[Qu2022, Section III-A] fits a polynomial (`polynomial_fit.py`) of a degree that the paper does not
report. `select` compares a straight line with a path of constant turn rate instead. World frame in
the plane, SI units, one target; use `jax.vmap` for several. The noise is Gaussian, equal on both
axes.

Before the first observation a target is assumed to move straight, or to turn left or right with
equal probability, at a rate whose magnitude is log-normal. The constants are for targets of 0.2 to
0.5 m/s that turn at 0.03 to 0.1 rad/s. Predictions of faster turns are hardly worse. Slower turns
are often mistaken for straight paths.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from planner_jax.core.errors import ArgumentError
from planner_jax.plane.target import TurningPath
from planner_jax.sims.prediction.observed import centre
from planner_jax.sims.prediction.turn_fit import best_turn, fit_rate, path_of, tangent

_CHANCE = 0.4  # prior probability that a target turns
_TYPICAL = 0.065  # [rad/s], prior median of the turn rate's magnitude
_SPREAD = 0.4  # prior standard deviation of the logarithm of the magnitude
# Half width of the interval of evaluated turn rates, in standard deviations of the turn rate.
_REACH = 5.0
_OFFSETS = np.linspace(-1.0, 1.0, 49)  # evaluated turn rates, relative to that half width


def select(
    times: ArrayLike, positions: ArrayLike, noise: float, weights: ArrayLike | None = None
) -> TurningPath:
    """Predict a target: return a straight path or a path of constant turn rate.

    The posterior probability of every turn rate follows from Bayes' rule and quadrature over the
    rate. The prior of position and velocity is flat. The selected path has the median turn rate.
    The median is zero unless turns to one side are more probable than all other alternatives
    together. Weak turns are therefore shrunk towards zero, and the path does not jump as
    observations change (posterior median thresholding [Johnstone2004]). With fewer than three
    observations the path is straight.

    Args:
        times: (L,) [s], times of L observations. Time 0 of the path should not be far from them.
        positions: (L, 2) [m], observed positions of the target.
        noise: [m] > 0, standard deviation of a coordinate of an observation of weight 1.
        weights: (L,) >= 0, proportional to the inverse variance of each observation; 1 by default.
            An observation of weight zero, or not finite, is absent.

    Raises:
        ValueError: the arrays hold too few observations, the shapes do not match, or the noise is
            not positive.
    """
    if not noise > 0.0:
        raise ArgumentError("noise", "> 0", noise)
    seen = centre(times, positions, weights, 3)
    dtype = seen.after.dtype
    best = best_turn(seen)
    variance = jnp.square(jnp.asarray(noise, dtype))
    # Turn rates are evaluated around the best rate, which is shifted towards zero if the
    # observations determine it poorly.
    information = tangent(seen, best)[1] / variance
    prior_variance = jnp.square(_TYPICAL) * jnp.exp(2.0 * jnp.square(_SPREAD))
    precision = information + 1.0 / jnp.asarray(prior_variance, dtype)
    reach = _REACH / jnp.sqrt(precision)
    step = reach * (_OFFSETS[1] - _OFFSETS[0])
    rates = best.rate * information / precision + reach * jnp.asarray(_OFFSETS, dtype)
    fits = jax.vmap(fit_rate, in_axes=(None, 0))(seen, jnp.append(jnp.zeros((), dtype), rates))
    chance = jnp.asarray(_CHANCE, dtype)
    of_turns = log_density(rates) + jnp.log(step) + jnp.log(chance)
    log_prior = jnp.append(jnp.log1p(-chance), of_turns)
    power = jnp.where(fits.power > 0.0, fits.power, 1.0)
    gains = (fits.squares - best.squares) / variance
    likely = jax.nn.softmax(log_prior - 0.5 * gains - jnp.log(power))
    rate = _median(rates, step, likely[1:], likely[0])
    return path_of(seen, fit_rate(seen, jnp.where(seen.num >= 3, rate, 0.0)))


def log_density(rate: Array) -> Array:
    """Return the logarithm (...) of the prior density [s/rad] at turn rates (...) [rad/s]."""
    turns = rate != 0.0
    size = jnp.log(jnp.where(turns, jnp.abs(rate), 1.0))
    apart = (size - jnp.log(_TYPICAL)) / _SPREAD
    density = -size - 0.5 * apart**2 - jnp.log(_SPREAD) - 0.5 * np.log(8.0 * np.pi)
    return jnp.where(turns, density, -jnp.inf)


def _median(rates: Array, step: Array, chance: Array, of_zero: Array) -> Array:
    below = jnp.cumsum(chance) - chance
    right = jnp.sum(jnp.where(rates < 0.0, chance, 0.0)) <= 0.5  # whether the median is >= 0
    level = jnp.where(right, 0.5 - of_zero, 0.5)
    wide = chance > jnp.finfo(chance.dtype).eps
    inside = jnp.clip((level - below) / jnp.where(wide, chance, 1.0), 0.0, 1.0)
    share = jnp.where(wide, inside, level > below)
    rate = rates[0] + step * (jnp.sum(share) - 0.5)
    return jnp.where(right, jnp.maximum(rate, 0.0), jnp.minimum(rate, 0.0))
