"""Least-squares fit of a ball's flight to its observations [Natarajan2024, eqs 5 to 8].

Without drag, once the known term of gravity is removed, the position is linear in six unknowns:
the ball's position and velocity at one time. The normal equations are therefore a linear system of
size six. Its unknowns are centred and scaled by the mean and the spread of the observations. The
system is solved a second time for the residuals of the first solution, so that float32 suffices
even if depths are a hundred times less certain than other coordinates. World frame with z up, SI
units. The functions treat one ball; use `jax.vmap` for a batch.

Every fit uses all observations up to its time, from an array of fixed size in which later
observations are NaN. No state is stored between fits, and every fit takes the same time.
"""

import dataclasses
import enum

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import PyTree

from planner_jax.ball.estimation import EkfState, solve_definite
from planner_jax.ball.flight import BallState, drag_free_flight
from planner_jax.core.origin import split_far, to_world


class Sight(enum.IntEnum):
    """The outcome of observing a ball: a fit of its flight, or the reason why there is none."""

    SEEN = 0
    NEVER_SEEN = 1
    SEEN_ONCE = 2
    IMPRECISE = 3

    @property
    def message(self) -> str:
        """Sentence for the user, with advice if there were too few observations for a fit."""
        return _MESSAGES[self]


_MESSAGES = {
    Sight.SEEN: "seen often enough for a flight",
    Sight.NEVER_SEEN: "the camera never sees the ball; check its direction, and the ball's colour",
    Sight.SEEN_ONCE: "seen at one time only, which gives no velocity; observe for longer",
    Sight.IMPRECISE: "the times or positions are too large for their type, or not finite; pass "
    "NumPy arrays in float64, outside compiled functions",
}

_ROUNDING = 1e-3  # greatest rounding error of times or positions, relative to their spread


@struct.dataclass
class FlightFit:
    """A fitted flight and its uncertainty; NaN if the ball was seen at fewer than two times."""

    belief: EkfState  # mean and covariance of the ball's position and velocity at `time`
    time: Array  # () [s], weighted mean of the times of the observations
    # () Root mean square of the residuals, each divided by its standard deviation; about 1 if the
    # standard deviations are right.
    misfit: Array
    num: Array  # () int32, number of fitted observations
    status: Array  # () int32, a `Sight`: whether there is a fit

    @property
    def ball(self) -> BallState:
        """Estimated position and velocity of the ball at the mean time of its observations."""
        return self.belief.ball


def fit_flight(times: Array, places: Array, information: ArrayLike, gravity: Array) -> FlightFit:
    """Fit a drag-free flight to observed positions by least squares; usable with jit and vmap.

    The fit minimises  sum_k e_k' W_k e_k  over the ball's position p and velocity v at time 0,
    where e_k = p + v t_k - (0, 0, g t_k^2 / 2) - x_k is the error of the observation x_k. If the
    weights W_k are equal, this is [Natarajan2024, eq. 8]. The fit's covariance is correct if every
    W_k is the inverse covariance of its observation.

    Args:
        times: (N,) [s], times t_k of N observations, in any order.
        places: (N, 3) [m], observed positions x_k. A position that is not finite is ignored, so
            that arrays of a fixed shape can hold fewer observations.
        information: W_k [1/m^2], (N, 3, 3); or (N,) or () for isotropic noise. An observation with
            zero information is ignored too.
        gravity: () [m/s^2], magnitude g.

    Returns:
        The fit. In NumPy arrays in float64, times and positions may be large, such as stamps since
        1970 and UTM coordinates: multiples of 100 s and 100 m near the first ones are subtracted.
        Otherwise the status is IMPRECISE if rounding of times or positions changes the velocity.
    """
    given = times, places, information, gravity
    if any(isinstance(leaf, Tracer) for leaf in given) or np.result_type(times) != np.float64:
        return _fit(*given)
    finite = np.asarray(times)[np.isfinite(times)]
    begin = np.round(finite[0], -2) if finite.size else 0.0
    seen = np.flatnonzero(np.isfinite(places).all(axis=-1))
    first = seen[0] if seen.size else 0
    near, away = split_far(np.roll(np.asarray(places), -first, axis=0))
    fit = _fit(times - begin, np.roll(near, first, axis=0), information, gravity)
    mean = fit.belief.mean
    if away is not None:
        mean = np.append(to_world(mean[:3], away), mean[3:])
    belief = dataclasses.replace(fit.belief, mean=mean)
    return dataclasses.replace(fit, belief=belief, time=np.asarray(fit.time, float) + begin)


@jax.jit
def _fit(times: Array, places: Array, information: ArrayLike, gravity: Array) -> FlightFit:
    dtype = places.dtype
    weights = jnp.asarray(information, dtype)
    if weights.ndim < 3:
        isotropic = jnp.broadcast_to(weights, times.shape)
        weights = isotropic[:, None, None] * jnp.eye(3, dtype=dtype)[None]
    trace = jnp.trace(weights, axis1=1, axis2=2)
    present = jnp.isfinite(times) & jnp.all(jnp.isfinite(places), axis=1) & (trace > 0.0)
    present = present & jnp.isfinite(trace)
    weights = jnp.where(present[:, None, None], weights, 0.0)
    share = jnp.where(present, trace, 0.0)
    share = share / jnp.where(jnp.any(present), jnp.sum(share), 1.0)

    times, places = jnp.where(present, times, 0.0), jnp.where(present[:, None], places, 0.0)
    middle = jnp.sum(share * times)
    after = jnp.where(present, times - middle, 0.0)
    square = jnp.sum(share * after**2)
    num = jnp.sum(present).astype(jnp.int32)
    enough = (num >= 2) & (square > 1e-12)
    scale = jnp.where(enough, jnp.sqrt(jnp.where(enough, square, 1.0)), 1.0)
    steps = after / scale
    fallen = places + 0.5 * gravity * after[:, None] ** 2 * jnp.array([[0.0, 0.0, 1.0]], dtype)
    centre = jnp.sum(share[:, None] * fallen, axis=0)
    seen = jnp.where(present[:, None], fallen - centre[None], 0.0)

    normal = jnp.block(
        [
            [jnp.sum(weights, axis=0), jnp.sum(steps[:, None, None] * weights, axis=0)],
            [
                jnp.sum(steps[:, None, None] * weights, axis=0),
                jnp.sum(steps[:, None, None] ** 2 * weights, axis=0),
            ],
        ]
    )
    # The normal equations are singular with too few observations: replace their matrix by I.
    normal = jnp.where(enough, normal, jnp.eye(6, dtype=dtype))

    def residuals(unknowns: Array) -> Array:
        return seen - unknowns[None, :3] - steps[:, None] * unknowns[None, 3:]

    def refine(unknowns: Array) -> Array:
        pull = jnp.einsum(
            "nij,nj->ni", weights, residuals(unknowns), precision=lax.Precision.HIGHEST
        )
        slope = jnp.concatenate([jnp.sum(pull, axis=0), jnp.sum(steps[:, None] * pull, axis=0)])
        return unknowns + solve_definite(normal, slope[:, None])[:, 0]

    unknowns = refine(refine(jnp.zeros(6, dtype)))
    inverse = solve_definite(normal, jnp.eye(6, dtype=dtype))
    units = jnp.concatenate([jnp.ones(3, dtype), jnp.full(3, 1.0, dtype) / scale])
    mean = units * unknowns + jnp.concatenate([centre, jnp.zeros(3, dtype)])
    covariance = 0.5 * units[:, None] * (inverse + inverse.T) * units[None]
    off = residuals(unknowns)
    squares = jnp.einsum("ni,nij,nj->", off, weights, off, precision=lax.Precision.HIGHEST)
    free = jnp.maximum(3 * num - 6, 1)
    unseen = jnp.where(num == 0, Sight.NEVER_SEEN, Sight.SEEN_ONCE)
    eps, noise = jnp.finfo(dtype).eps, jnp.sqrt(3.0 * num / jnp.sum(jnp.where(present, trace, 0.0)))
    far = jnp.maximum(_ROUNDING * jnp.max(jnp.abs(seen)), noise)
    exact = (eps * jnp.max(jnp.abs(times)) <= _ROUNDING * scale) & jnp.isfinite(squares)
    exact = exact & (eps * jnp.max(jnp.abs(places)) <= far) & jnp.all(jnp.isfinite(mean))
    seen_well = jnp.where(exact, Sight.SEEN, Sight.IMPRECISE)
    return FlightFit(
        belief=EkfState(
            mean=jnp.where(enough, mean, jnp.nan), covariance=jnp.where(enough, covariance, jnp.nan)
        ),
        time=middle,
        misfit=jnp.where(enough, _root(squares / free), jnp.nan),
        num=num,
        status=jnp.where(enough, seen_well, unseen).astype(jnp.int32),
    )


def belief_at(fit: FlightFit, time: Array, gravity: Array) -> EkfState:
    """Return mean and covariance of position and velocity at a time () [s], from a fitted flight.

    The time may lie before, between or after the observations.
    """
    start, away = split_far(fit.ball.pos)
    ahead = time - fit.time  # in float64, if both are on the host
    ahead = jnp.asarray(ahead, fit.belief.covariance.dtype)
    ball = drag_free_flight(BallState(start, fit.ball.vel), ahead, gravity)
    P = fit.belief.covariance
    place, both, speed = P[:3, :3], P[:3, 3:], P[3:, 3:]
    to_speed = both + ahead * speed
    moved = place + ahead * (both.T + to_speed)
    mean: PyTree = jnp.concatenate([ball.pos, ball.vel])
    if away is not None:
        mean = np.append(to_world(mean[:3], away), mean[3:])
    return EkfState(
        mean=mean,
        covariance=jnp.block([[moved, to_speed], [to_speed.T, speed]]),
    )


def across_std(belief: EkfState) -> Array:
    """Return the standard deviation () [m] of the ball's position normal to its velocity.

    It is the square root of the summed variances along both directions normal to the estimated
    velocity. An error along the velocity does not count, because it only shifts the contact time.
    """
    place, vel = belief.covariance[:3, :3], belief.mean[3:]
    along = jnp.einsum("i,ij,j->", vel, place, vel, precision=lax.Precision.HIGHEST)
    speed_squared = jnp.maximum(jnp.sum(vel**2), 1e-12)
    return _root(jnp.trace(place) - along / speed_squared)


def error_across(belief: EkfState, ball: BallState) -> Array:
    """Return the estimated position's error () [m] normal to the true ball's velocity.

    To first order in the error, this is the distance between the expected and the true contact
    point on a shield that faces the ball.
    """
    off = belief.mean[:3] - ball.pos
    along = jnp.sum(off * ball.vel) / jnp.maximum(jnp.sum(ball.vel**2), 1e-12)
    return _root(jnp.sum((off - along * ball.vel) ** 2))


def _root(square: Array) -> Array:
    """Return the square root; 0 with the derivative 0 if rounding made `square` negative."""
    there = square > 0.0
    # `square` is NaN if the ball was not seen; then 0 * square keeps NaN in the result.
    return jnp.where(there, jnp.sqrt(jnp.where(there, square, 1.0)), 0.0 * square)
