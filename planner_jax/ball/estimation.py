"""The state of a ball from its observations, by an extended Kalman filter.

The filter is that of [Yu2023bat, eq. 5] (from [Yu2023catch, Section V-A]). World frame, z up, SI
units, one ball; `jax.vmap` makes many. An observation with a NaN leaves the state unchanged.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jaxtyping import Float

from planner_jax.ball.flight import BallState, linear_drag_flight

# (ball, duration, drag, gravity) -> ball: `linear_drag_flight` or `rk4_step`.
Flight = Callable[[BallState, Array, Array, Array], BallState]


@struct.dataclass
class EkfModel:
    """What the filter believes about the flight and about the sensor."""

    drag: Array  # (3,) K_i [1/s] for `linear_drag_flight`, () K_D [1/m] for `rk4_step`
    gravity: Array  # () [m/s^2], magnitude
    acceleration_density: Array  # () [m^2/s^3], of a white acceleration that the flight leaves out
    observation_std: Array  # () or (3,) [m], of an observed position


@struct.dataclass
class EkfState:
    """A Gaussian belief about position (first three) and velocity (last three) of the ball."""

    mean: Array  # (6,) [m, m/s]
    covariance: Array  # (6, 6)

    @property
    def ball(self) -> BallState:
        """The mean as a ball, leaves (..., 3)."""
        return BallState(pos=self.mean[..., :3], vel=self.mean[..., 3:])


def _congruence(A: Array, P: Array) -> Array:
    """A P A'  at full precision on every device, symmetric to the last bit."""
    full = jnp.einsum("ij,jk,lk->il", A, P, A, precision=lax.Precision.HIGHEST)
    return 0.5 * (full + full.T)


def solve_definite(A: Array, B: Array) -> Array:
    """The X (m, n) of  A X = B  for a symmetric positive definite A (m, m), m small.

    Elimination without exchanges, written out: plain arithmetic on every device, at full
    precision, without a library call a lane.
    """
    U, X = list(A), list(B)
    size = len(U)
    for i in range(size):
        for j in range(i + 1, size):
            factor = U[j][i] / U[i][i]
            U[j], X[j] = U[j] - factor * U[i], X[j] - factor * X[i]
    for i in reversed(range(size)):
        X[i] = (X[i] - sum(U[i][k] * X[k] for k in range(i + 1, size))) / U[i][i]
    return jnp.stack(X)


def ekf_init(
    pos: Float[Array, "3"], vel: Float[Array, "3"], *, pos_std: Array, vel_std: Array
) -> EkfState:
    """The belief before the first observation.

    Args:
        pos: (3,) [m].
        vel: (3,) [m/s].
        pos_std: () or (3,) [m], standard deviation of each coordinate; it may be wide.
        vel_std: () or (3,) [m/s]. In float32 keep vel_std times the time between two
            observations below 1000 times their standard deviation: at 3000 the covariance
            after the second observation is lost in rounding.
    """
    std = jnp.concatenate([jnp.ones_like(pos) * pos_std, jnp.ones_like(vel) * vel_std])
    return EkfState(mean=jnp.concatenate([pos, vel]), covariance=jnp.diag(std**2))


def ekf_predict(
    state: EkfState, duration: Array, model: EkfModel, *, flight: Flight = linear_drag_flight
) -> EkfState:
    """The belief after `duration` [s] >= 0 of flight with nothing observed.

    The mean flies, and the covariance becomes F P F' + Q, F the Jacobian of the flight. With
    `linear_drag_flight` this is [Yu2023catch, eq. 10], but exact in the duration (the print moves
    the position by v dt alone). With `rk4_step` the duration is one Runge-Kutta step. Q is the
    integral of a white acceleration over the duration.
    """

    def transition(mean: Array) -> Array:
        before = BallState(pos=mean[:3], vel=mean[3:])
        after = flight(before, duration, model.drag, model.gravity)
        return jnp.concatenate([after.pos, after.vel])

    F = jax.jacfwd(transition)(state.mean)
    t = jnp.asarray(duration, state.mean.dtype)
    per_axis = jnp.stack([jnp.stack([t**3 / 3.0, t**2 / 2.0]), jnp.stack([t**2 / 2.0, t])])
    Q = model.acceleration_density * jnp.kron(per_axis, jnp.eye(3, dtype=t.dtype))
    return EkfState(mean=transition(state.mean), covariance=_congruence(F, state.covariance) + Q)


def ekf_update(state: EkfState, observation: Float[Array, "3"], model: EkfModel) -> EkfState:
    """The belief after one observed position, s + K_a (Z - H s)  [Yu2023bat, eq. 5].

    H = [I 0]. The covariance takes Joseph's form, which stays positive definite in float32
    also when a wide prior meets a sharp observation.

    Args:
        state: the belief at the time of the observation.
        observation: (3,) Z [m]. Where any coordinate is not finite, the belief stays as it is.
        model: only the sensor is used.
    """
    observed = jnp.all(jnp.isfinite(observation))
    dtype = state.mean.dtype
    R = jnp.diag(jnp.ones(3, dtype) * model.observation_std**2)
    P = state.covariance
    residual = jnp.where(observed, observation, state.mean[:3]) - state.mean[:3]
    K = solve_definite(P[:3, :3] + R, P[:3]).T
    kept = jnp.eye(6, dtype=dtype) - jnp.pad(K, ((0, 0), (0, 3)))  # I - K H
    return EkfState(
        mean=state.mean + jnp.matmul(K, residual, precision=lax.Precision.HIGHEST),
        covariance=jnp.where(observed, _congruence(kept, P) + _congruence(K, R), P),
    )
