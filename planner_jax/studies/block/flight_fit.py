"""The flight of a ball by least squares through where it was seen [Natarajan2024, eqs 5 to 8].

Without drag a flight is linear in where the ball is and how fast at any one time, once the known
fall is taken off: the least squares are six linear equations. They are set up around the
observations' own middle and scale, and solved twice, the second time for what the first left, so
that float32 does where depths are a hundred times less certain than what lies across. World frame,
z up, SI units, one ball; `jax.vmap` makes many.

Nothing has to be kept from one fit to the next: all that was seen so far, as one buffer with NaN
for what is still to come, is fitted anew in constant time.
"""

import enum

import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jax.typing import ArrayLike

from planner_jax.ball.estimation import EkfState, solve_definite
from planner_jax.ball.flight import BallState, drag_free_flight


class Sight(enum.IntEnum):
    """What became of looking for one ball."""

    SEEN = 0
    NEVER_SEEN = 1
    SEEN_ONCE = 2

    @property
    def message(self) -> str:
        """A sentence for the user, with the remedy."""
        return _MESSAGES[self]


_MESSAGES = {
    Sight.SEEN: "seen often enough for a flight",
    Sight.NEVER_SEEN: "the camera never sees the ball; check where it looks, and the ball's colour",
    Sight.SEEN_ONCE: "seen at one time only, which tells no velocity; look for longer",
}


@struct.dataclass
class FlightFit:
    """A flight, and how well it is known; NaN where the ball was not seen at two times."""

    belief: EkfState  # about position and velocity at `time`
    time: Array  # () [s], weighted middle of the observations
    misfit: Array  # () root mean square of what they are off, in standard deviations; 1 as believed
    num: Array  # () int32, observations that were fitted
    status: Array  # () int32, a `Sight`

    @property
    def ball(self) -> BallState:
        """The ball at `time`."""
        return self.belief.ball


def fit_flight(times: Array, places: Array, information: ArrayLike, gravity: Array) -> FlightFit:
    """The free flight of least squares through observations; pure, so jit and vmap it.

    Minimises  sum_k e_k' W_k e_k,  e_k = p + v t_k - (0, 0, g t_k^2 / 2) - x_k.  With equal weights
    this is [Natarajan2024, eq. 8]. The covariance is that of the estimate if every W_k is the
    inverse of its observation's.

    Args:
        times: (N,) [s], in no order.
        places: (N, 3) x_k [m]. One that is not finite counts as absent, so that shapes stay fixed.
        information: W_k [1/m^2], (N, 3, 3); or (N,) or () where the noise is as large in every
            direction. One of zero is absent too.
        gravity: () [m/s^2], magnitude.
    """
    dtype = places.dtype
    weights = jnp.asarray(information, dtype)
    if weights.ndim < 3:
        alike = jnp.broadcast_to(weights, times.shape)
        weights = alike[:, None, None] * jnp.eye(3, dtype=dtype)
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
    fallen = places + 0.5 * gravity * after[:, None] ** 2 * jnp.array([0.0, 0.0, 1.0], dtype)
    centre = jnp.sum(share[:, None] * fallen, axis=0)
    seen = jnp.where(present[:, None], fallen - centre, 0.0)

    normal = jnp.block(
        [
            [jnp.sum(weights, axis=0), jnp.sum(steps[:, None, None] * weights, axis=0)],
            [
                jnp.sum(steps[:, None, None] * weights, axis=0),
                jnp.sum(steps[:, None, None] ** 2 * weights, axis=0),
            ],
        ]
    )
    # A lane without a flight solves something harmless.
    normal = jnp.where(enough, normal, jnp.eye(6, dtype=dtype))

    def left(unknowns: Array) -> Array:
        """What the observations are off a flight, (N, 3) [m]."""
        return seen - unknowns[:3] - steps[:, None] * unknowns[3:]

    def better(unknowns: Array) -> Array:
        pull = jnp.einsum("nij,nj->ni", weights, left(unknowns), precision=lax.Precision.HIGHEST)
        slope = jnp.concatenate([jnp.sum(pull, axis=0), jnp.sum(steps[:, None] * pull, axis=0)])
        return unknowns + solve_definite(normal, slope[:, None])[:, 0]

    unknowns = better(better(jnp.zeros(6, dtype)))
    inverse = solve_definite(normal, jnp.eye(6, dtype=dtype))
    units = jnp.concatenate([jnp.ones(3, dtype), jnp.full(3, 1.0, dtype) / scale])
    mean = units * unknowns + jnp.concatenate([centre, jnp.zeros(3, dtype)])
    covariance = 0.5 * units[:, None] * (inverse + inverse.T) * units
    off = left(unknowns)
    squares = jnp.einsum("ni,nij,nj->", off, weights, off, precision=lax.Precision.HIGHEST)
    free = jnp.maximum(3 * num - 6, 1)
    unseen = jnp.where(num == 0, Sight.NEVER_SEEN, Sight.SEEN_ONCE)
    return FlightFit(
        belief=EkfState(
            mean=jnp.where(enough, mean, jnp.nan),
            covariance=jnp.where(enough, covariance, jnp.nan),
        ),
        time=middle,
        misfit=jnp.where(enough, _root(squares / free), jnp.nan),
        num=num,
        status=jnp.where(enough, Sight.SEEN, unseen).astype(jnp.int32),
    )


def believed_at(fit: FlightFit, time: Array, gravity: Array) -> EkfState:
    """The belief about the ball at a time () [s], before or after it was seen."""
    ahead = jnp.asarray(time, fit.time.dtype) - fit.time
    ball = drag_free_flight(fit.ball, ahead, gravity)
    P = fit.belief.covariance
    place, both, speed = P[:3, :3], P[:3, 3:], P[3:, 3:]
    to_speed = both + ahead * speed
    moved = place + ahead * (both.T + to_speed)
    return EkfState(
        mean=jnp.concatenate([ball.pos, ball.vel]),
        covariance=jnp.block([[moved, to_speed], [to_speed.T, speed]]),
    )


def across_std(belief: EkfState) -> Array:
    """Root mean square () [m] of how far the ball passes from where it is believed to.

    That is the error of the position across the believed velocity; what lies along it is an error
    of time only.
    """
    place, vel = belief.covariance[:3, :3], belief.mean[3:]
    along = jnp.einsum("i,ij,j->", vel, place, vel, precision=lax.Precision.HIGHEST)
    speed_squared = jnp.maximum(jnp.sum(vel**2), 1e-12)
    return _root(jnp.trace(place) - along / speed_squared)


def error_across(belief: EkfState, ball: BallState) -> Array:
    """How far () [m] a ball at the believed time passes from where it is believed to.

    It is the part of the position's error across the ball's own velocity, to first order in the
    error the distance at which it meets a shield that waits for it straight on.
    """
    off = belief.mean[:3] - ball.pos
    along = jnp.sum(off * ball.vel) / jnp.maximum(jnp.sum(ball.vel**2), 1e-12)
    return _root(jnp.sum((off - along * ball.vel) ** 2))


def _root(square: Array) -> Array:
    """The root () of what is a square but for rounding; of slope zero at zero."""
    there = square > 0.0
    # NaN, of a ball that was not seen, stays NaN.
    return jnp.where(there, jnp.sqrt(jnp.where(there, square, 1.0)), 0.0 * square)
