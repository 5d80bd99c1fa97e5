"""Extended Kalman filter of a ball's state [Yu2023bat, eq. 5; Yu2023catch, Section V-A].

World frame, z up, SI units. Functions take one ball; use `jax.vmap` for many.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jaxtyping import Float

from planner_jax.ball.flight import BallState
from planner_jax.ball.linear_drag import linear_drag_flight

# A flight model, such as `rk4_step`: a function (ball, duration, drag, gravity) -> ball.
Flight = Callable[[BallState, Array, Array, Array], BallState]


@struct.dataclass
class EkfModel:
    """Parameters of the Kalman filter: the ball's flight, and the noise of flight and sensor."""

    drag: Array  # (3,) K_i [1/s] for `linear_drag_flight`, () K_D [1/m] for `rk4_step`
    gravity: Array  # () [m/s^2], magnitude
    # () [m^2/s^3], power spectral density of the process noise, a white acceleration.
    acceleration_density: Array
    observation_std: Array  # () or (3,) [m], standard deviation of an observed position


@struct.dataclass
class EkfState:
    """A Gaussian belief about the ball's state: position [m] (entries 0 to 2), velocity [m/s]."""

    mean: Array  # (6,) [m, m/s]
    covariance: Array  # (6, 6)

    @property
    def ball(self) -> BallState:
        """Mean of the belief as a ball, whose position and velocity are (..., 3)."""
        return BallState(pos=self.mean[..., :3], vel=self.mean[..., 3:])


def congruence(A: Array, P: Array) -> Array:
    """Return A P A^T in full precision (a GPU may use TF32 otherwise), exactly symmetric."""
    full = jnp.einsum("ij,jk,lk->il", A, P, A, precision=lax.Precision.HIGHEST)
    return 0.5 * (full + full.T)


def solve_definite(A: Array, B: Array) -> Array:
    """Solve A X = B for X (m, n) by unrolled elimination; A (m, m) must be positive definite."""
    import chex  # only where a function is traced, as its import takes a tenth of a second

    U, X = list(A), list(B)
    size = len(U)
    chex.assert_shape(A, (size, size))
    chex.assert_shape(B, (size, ...))
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
    """Make the Gaussian belief about a ball's position and velocity before any observation.

    Args:
        pos: (3,) [m], expected position of the ball.
        vel: (3,) [m/s], expected velocity of the ball.
        pos_std: () or (3,) [m], standard deviation of each coordinate of the position.
        vel_std: () or (3,) [m/s], standard deviation of each coordinate of the velocity. In
            float32 vel_std * (time between observations) should be below 1000 times the standard
            deviation of an observed position, as larger covariances have large rounding errors.
    """
    import chex

    chex.assert_shape([pos, vel], (3,))
    std = jnp.concatenate([jnp.ones_like(pos) * pos_std, jnp.ones_like(vel) * vel_std])
    return EkfState(mean=jnp.concatenate([pos, vel]), covariance=jnp.diag(std**2))


def ekf_predict(
    state: EkfState, duration: Array, model: EkfModel, *, flight: Flight = linear_drag_flight
) -> EkfState:
    """Predict the belief after `duration` [s] >= 0 without an observation.

    The covariance P becomes F P F^T + Q. F is the Jacobian of the flight; Q is the covariance that
    a white acceleration causes during `duration`. With `linear_drag_flight` this is [Yu2023catch,
    eq. 10], except that the paper neglects the acceleration when it predicts the position.
    """
    import chex

    chex.assert_shape([state.mean, state.covariance, duration], [(6,), (6, 6), ()])

    def transition(mean: Array) -> Array:
        after = flight(BallState(pos=mean[:3], vel=mean[3:]), duration, model.drag, model.gravity)
        return jnp.concatenate([after.pos, after.vel])

    F = jax.jacfwd(transition)(state.mean)
    t = jnp.asarray(duration, state.mean.dtype)
    per_axis = jnp.stack([jnp.stack([t**3 / 3.0, t**2 / 2.0]), jnp.stack([t**2 / 2.0, t])])
    Q = model.acceleration_density * jnp.kron(per_axis, jnp.eye(3, dtype=t.dtype))
    return EkfState(mean=transition(state.mean), covariance=congruence(F, state.covariance) + Q)


def ekf_update(state: EkfState, observation: Float[Array, "3"], model: EkfModel) -> EkfState:
    """Update the belief with an observed position Z (3,) [m] [Yu2023bat, eq. 5].

    [Yu2023catch, eq. 11] is the same equation. The mean s becomes s + K_a (Z - H s), where H = [I
    0] selects the position and K_a is the Kalman gain. The covariance is updated in Joseph's form,
    which stays positive definite in float32. Only `observation_std` of the model is used. If a
    coordinate of the observation is not finite, the belief is returned unchanged.
    """
    import chex

    chex.assert_shape([observation, state.mean, state.covariance], [(3,), (6,), (6, 6)])
    observed = jnp.all(jnp.isfinite(observation))
    dtype = state.mean.dtype
    R = jnp.diag(jnp.ones(3, dtype) * model.observation_std**2)
    P = state.covariance
    residual = jnp.where(observed, observation, state.mean[:3]) - state.mean[:3]
    K = solve_definite(P[:3, :3] + R, P[:3]).T
    factor = jnp.eye(6, dtype=dtype) - jnp.pad(K, ((0, 0), (0, 3)))  # I - K H
    return EkfState(
        mean=state.mean + jnp.matmul(K, residual, precision=lax.Precision.HIGHEST),
        covariance=jnp.where(observed, congruence(factor, P) + congruence(K, R), P),
    )
