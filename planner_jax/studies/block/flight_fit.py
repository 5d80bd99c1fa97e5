"""Least-squares fit of a ball's flight to its observations [Natarajan2024, eqs 5 to 8].

After the known fall is subtracted, a drag-free flight is linear in the ball's position and velocity
at any one time: the least squares are six linear equations. The equations are centred and scaled by
the observations' own mean and spread, and solved twice, the second time for the residuals of the
first solution. This makes float32 sufficient even if depths are a hundred times less certain than
the other coordinates. World frame, z up, SI units, one ball; use `jax.vmap` for a batch.

Nothing is stored between fits. Every fit uses all observations so far, in one buffer with NaN for
later observations, and takes constant time.
"""

import enum

import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jax.typing import ArrayLike

from planner_jax.ball.estimation import EkfState, solve_definite
from planner_jax.ball.flight import BallState, drag_free_flight


class Sight(enum.IntEnum):
    """The outcome of observing one ball."""

    SEEN = 0
    NEVER_SEEN = 1
    SEEN_ONCE = 2

    @property
    def message(self) -> str:
        """A sentence for the user that also names the remedy."""
        return _MESSAGES[self]


_MESSAGES = {
    Sight.SEEN: "seen often enough for a flight",
    Sight.NEVER_SEEN: "the camera never sees the ball; check its direction, and the ball's colour",
    Sight.SEEN_ONCE: "seen at one time only, which gives no velocity; observe for longer",
}


@struct.dataclass
class FlightFit:
    """A fitted flight and its uncertainty; NaN if the ball was not seen at two times."""

    belief: EkfState  # about position and velocity at `time`
    time: Array  # () [s], weighted middle of the observations
    misfit: Array  # () root mean square residual in standard deviations; 1 is expected
    num: Array  # () int32, number of fitted observations
    status: Array  # () int32, a `Sight`

    @property
    def ball(self) -> BallState:
        """The ball at `time`."""
        return self.belief.ball


def fit_flight(times: Array, places: Array, information: ArrayLike, gravity: Array) -> FlightFit:
    """Return the least-squares free flight through observations; pure, so jit and vmap it.

    Minimises  sum_k e_k' W_k e_k,  e_k = p + v t_k - (0, 0, g t_k^2 / 2) - x_k.  With equal weights
    this is [Natarajan2024, eq. 8]. The covariance is correct if every W_k is the inverse covariance
    of its observation.

    Args:
        times: (N,) [s], in any order.
        places: (N, 3) x_k [m]. A position that is not finite counts as absent, so that shapes stay
            fixed.
        information: W_k [1/m^2], (N, 3, 3); or (N,) or () for isotropic noise. An observation with
            zero information is absent too.
        gravity: () [m/s^2], magnitude.
    """
    dtype = places.dtype
    weights = jnp.asarray(information, dtype)
    if weights.ndim < 3:
        isotropic = jnp.broadcast_to(weights, times.shape)
        weights = isotropic[:, None, None] * jnp.eye(3, dtype=dtype)
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
    # Without a flight the identity is solved instead.
    normal = jnp.where(enough, normal, jnp.eye(6, dtype=dtype))

    def residuals(unknowns: Array) -> Array:
        """Return the residuals of the observations, (N, 3) [m]."""
        return seen - unknowns[:3] - steps[:, None] * unknowns[3:]

    def refine(unknowns: Array) -> Array:
        """Return the solution after one step of iterative refinement."""
        pull = jnp.einsum(
            "nij,nj->ni", weights, residuals(unknowns), precision=lax.Precision.HIGHEST
        )
        slope = jnp.concatenate([jnp.sum(pull, axis=0), jnp.sum(steps[:, None] * pull, axis=0)])
        return unknowns + solve_definite(normal, slope[:, None])[:, 0]

    unknowns = refine(refine(jnp.zeros(6, dtype)))
    inverse = solve_definite(normal, jnp.eye(6, dtype=dtype))
    units = jnp.concatenate([jnp.ones(3, dtype), jnp.full(3, 1.0, dtype) / scale])
    mean = units * unknowns + jnp.concatenate([centre, jnp.zeros(3, dtype)])
    covariance = 0.5 * units[:, None] * (inverse + inverse.T) * units
    off = residuals(unknowns)
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


def belief_at(fit: FlightFit, time: Array, gravity: Array) -> EkfState:
    """Return the estimate of the ball at a time () [s], before or after its observations."""
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
    """Return the standard deviation () [m] of the ball's position normal to its estimated velocity.

    It is the root of the summed variances of both normal directions. An error along the velocity is
    only an error in time.
    """
    place, vel = belief.covariance[:3, :3], belief.mean[3:]
    along = jnp.einsum("i,ij,j->", vel, place, vel, precision=lax.Precision.HIGHEST)
    speed_squared = jnp.maximum(jnp.sum(vel**2), 1e-12)
    return _root(jnp.trace(place) - along / speed_squared)


def error_across(belief: EkfState, ball: BallState) -> Array:
    """Return the distance () [m] of the estimate from the true ball, normal to the ball's velocity.

    To first order in the error, it is the distance between expected and true contact on a shield
    that faces the ball.
    """
    off = belief.mean[:3] - ball.pos
    along = jnp.sum(off * ball.vel) / jnp.maximum(jnp.sum(ball.vel**2), 1e-12)
    return _root(jnp.sum((off - along * ball.vel) ** 2))


def _root(square: Array) -> Array:
    """Return the square root () of a square; zero with slope zero if rounding makes it negative."""
    there = square > 0.0
    # NaN, for a ball that was not seen, stays NaN.
    return jnp.where(there, jnp.sqrt(jnp.where(there, square, 1.0)), 0.0 * square)
