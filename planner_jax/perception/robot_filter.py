"""Error-state Kalman filter of a quadrotor from its IMU and captured poses.

Both [Yu2023catch, Section VII-A] and [Yu2023bat, Section VI-C] estimate the quadrotor's state by a
Kalman filter of these two sensors. World frame, z up, SI units; body rates and specific forces in
the body frame; quaternions w x y z, body to world. Functions take one quadrotor; use `jax.vmap`
for many.

The belief is a Gaussian of the error of the mean, in the frame of the estimated body: the true
state is `retract(mean, error)`, with the error (15,) of position [m], attitude [rad], velocity
[m/s], and of the biases of gyroscope [rad/s] and accelerometer [m/s^2].
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Float

from planner_jax.ball.estimation import congruence
from planner_jax.ball.flight import gravity_vector

_HIGHEST = lax.Precision.HIGHEST


@struct.dataclass
class BodyState:
    """Pose and velocity of a quadrotor, and the biases of its IMU.

    Attributes:
        pos: (3,) [m], position.
        quat_wxyz: (4,) unit quaternion of the rotation from body to world.
        vel: (3,) [m/s], velocity.
        rate_bias: (3,) [rad/s], the gyroscope's measurement minus the body rate.
        force_bias: (3,) [m/s^2], the accelerometer's measurement minus the specific force.
    """

    pos: Array
    quat_wxyz: Array
    vel: Array
    rate_bias: Array
    force_bias: Array


@struct.dataclass
class RobotFilterModel:
    """Gravity, and the noise of IMU and poses; every field is ().

    Attributes:
        gravity: [m/s^2], magnitude of gravity.
        rate_density: [rad^2/s], power spectral density of the gyroscope's noise. A sensor with
            independent errors of standard deviation s at the rate f has the density s^2 / f.
        force_density: [m^2/s^3], power spectral density of the accelerometer's noise.
        rate_bias_density: [rad^2/s^3], power spectral density of the derivative of the gyroscope's
            bias.
        force_bias_density: [m^2/s^5], power spectral density of the derivative of the
            accelerometer's bias.
        pos_std: [m], standard deviation of a coordinate of a captured position.
        attitude_std: [rad], standard deviation of each component of a captured attitude.
    """

    gravity: Array
    rate_density: Array
    force_density: Array
    rate_bias_density: Array
    force_bias_density: Array
    pos_std: Array
    attitude_std: Array


@struct.dataclass
class RobotFilterState:
    """The belief about a quadrotor, and the likelihood of all poses so far.

    Attributes:
        mean: estimated pose, velocity and biases.
        covariance: (15, 15) covariance of the error in the frame of the estimated body.
        log_likelihood: () sum of the logarithms of the densities of the observed poses.
    """

    mean: BodyState
    covariance: Array
    log_likelihood: Array


def multiply(a: Array, b: Array) -> Array:
    """Return the product (4,) of two quaternions: the rotation `b`, followed by `a`."""
    w, v = a[0] * b[0] - jnp.sum(a[1:] * b[1:]), a[0] * b[1:] + b[0] * a[1:]
    return jnp.concatenate([w[None], v + jnp.cross(a[1:], b[1:])])


def conjugate(quat: Array) -> Array:
    """Return the inverse (4,) of a unit quaternion."""
    return jnp.concatenate([quat[:1], -quat[1:]])


def rotate(quat: Array, vector: Array) -> Array:
    """Return a vector (3,) rotated by a unit quaternion (4,)."""
    twice = 2.0 * jnp.cross(quat[1:], vector)
    return vector + quat[0] * twice + jnp.cross(quat[1:], twice)


def exponential(turn: Array) -> Array:
    """Return the unit quaternion (4,) of a rotation vector (3,) [rad]."""
    square = jnp.sum(turn**2)
    is_small = square < 1e-6
    angle = jnp.sqrt(jnp.where(is_small, 1.0, square))
    half = jnp.where(is_small, 0.5 - square / 48.0, jnp.sin(0.5 * angle) / angle)
    cosine = jnp.where(is_small, 1.0 - square / 8.0, jnp.cos(0.5 * angle))
    return jnp.concatenate([cosine[None], half * turn])


def logarithm(quat: Array) -> Array:
    """Return the rotation vector (3,) [rad], of length at most pi, of a unit quaternion (4,)."""
    quat = jnp.where(quat[0] < 0.0, -quat, quat)
    square = jnp.sum(quat[1:] ** 2)
    is_small = square < 1e-6
    sine = jnp.sqrt(jnp.where(is_small, 1.0, square))
    ratio = jnp.where(is_small, 2.0 + square / 3.0, 2.0 * jnp.arctan2(sine, quat[0]) / sine)
    return ratio * quat[1:]


def retract(mean: BodyState, error: Float[Array, "15"]) -> BodyState:
    """Return the state whose error (15,) relative to `mean`, in its body frame, is `error`."""
    quat = multiply(mean.quat_wxyz, exponential(error[3:6]))
    return BodyState(
        pos=mean.pos + rotate(mean.quat_wxyz, error[:3]),
        quat_wxyz=quat / jnp.sqrt(jnp.sum(quat**2)),
        vel=mean.vel + rotate(mean.quat_wxyz, error[6:9]),
        rate_bias=mean.rate_bias + error[9:12],
        force_bias=mean.force_bias + error[12:],
    )


def difference(mean: BodyState, other: BodyState) -> Array:
    """Return the error (15,) with which `retract(mean, error)` is `other`."""
    inverse = conjugate(mean.quat_wxyz)
    return jnp.concatenate(
        [
            rotate(inverse, other.pos - mean.pos),
            logarithm(multiply(inverse, other.quat_wxyz)),
            rotate(inverse, other.vel - mean.vel),
            other.rate_bias - mean.rate_bias,
            other.force_bias - mean.force_bias,
        ]
    )


def robot_filter_init(
    mean: BodyState,
    *,
    pos_std: Array,
    attitude_std: Array,
    vel_std: Array,
    rate_bias_std: Array,
    force_bias_std: Array,
) -> RobotFilterState:
    """Make the belief about a quadrotor before any observation.

    Args:
        mean: expected state.
        pos_std: () [m], standard deviation of each coordinate of the position.
        attitude_std: () [rad], standard deviation of each component of the attitude.
        vel_std: () [m/s], standard deviation of each coordinate of the velocity.
        rate_bias_std: () [rad/s], standard deviation of each component of the gyroscope's bias.
        force_bias_std: () [m/s^2], standard deviation of each component of the accelerometer's.
    """
    stds = (pos_std, attitude_std, vel_std, rate_bias_std, force_bias_std)
    stds = jnp.repeat(jnp.stack([jnp.asarray(std, mean.pos.dtype) for std in stds]), 3)
    return RobotFilterState(mean, jnp.diag(stds**2), jnp.zeros((), mean.pos.dtype))


def predict_mean(
    mean: BodyState,
    force: Float[Array, "3"],
    rate: Float[Array, "3"],
    duration: Array,
    gravity: Array,
) -> BodyState:
    """Return the state after a measurement of the IMU that holds for `duration` () [s].

    The arguments are explained in `robot_filter_predict`; `gravity` () [m/s^2] is a magnitude.
    """
    t = duration
    pull, turn = force - mean.force_bias, (rate - mean.rate_bias) * t
    # Series of the integrals of exp([turn] s) pull from s = 0 to 1, once and twice.
    once, twice = pull / 24.0, pull / 120.0
    for first, second in ((6.0, 24.0), (2.0, 6.0), (1.0, 2.0)):
        once = pull / first + jnp.cross(turn, once)
        twice = pull / second + jnp.cross(turn, twice)
    fall = gravity_vector(gravity)
    quat = multiply(mean.quat_wxyz, exponential(turn))
    return dataclasses.replace(
        mean,
        pos=mean.pos + t * mean.vel + t**2 * (rotate(mean.quat_wxyz, twice) + 0.5 * fall),
        quat_wxyz=quat / jnp.sqrt(jnp.sum(quat**2)),
        vel=mean.vel + t * (rotate(mean.quat_wxyz, once) + fall),
    )


def robot_filter_predict(
    state: RobotFilterState,
    force: Float[Array, "3"],
    rate: Float[Array, "3"],
    duration: Array,
    model: RobotFilterModel,
) -> RobotFilterState:
    """Predict the belief by one measurement of the IMU, which holds for `duration` [s].

    Args:
        state: the belief before.
        force: (3,) [m/s^2], specific force that the accelerometer measures; (0, 0, g) at hover.
        rate: (3,) [rad/s], body rate that the gyroscope measures.
        duration: () [s], time since the last measurement, some milliseconds.
        model: gravity and noise.
    """
    t = jnp.asarray(duration, state.covariance.dtype)

    transition = functools.partial(
        predict_mean, force=force, rate=rate, duration=t, gravity=model.gravity
    )
    mean = transition(state.mean)
    zero = jnp.zeros(15, t.dtype)
    F = jax.jacfwd(lambda e: difference(mean, transition(retract(state.mean, e))))(zero)
    white = jnp.stack(
        [
            model.force_density * t**3 / 3.0,
            model.rate_density * t,
            model.force_density * t,
            model.rate_bias_density * t,
            model.force_bias_density * t,
        ]
    )
    both = jnp.zeros((5, 5), t.dtype).at[[0, 2], [2, 0]].set(model.force_density * t**2 / 2.0)
    Q = jnp.kron(jnp.diag(white) + both, jnp.eye(3, dtype=t.dtype))
    return dataclasses.replace(state, mean=mean, covariance=congruence(F, state.covariance) + Q)


def robot_filter_update(
    state: RobotFilterState,
    pos: Float[Array, "3"],
    quat_wxyz: Float[Array, "4"],
    model: RobotFilterModel,
) -> RobotFilterState:
    """Update the belief with a captured pose, in Joseph's form, which suits float32.

    Args:
        state: the belief before, at the time of the pose.
        pos: (3,) [m], captured position.
        quat_wxyz: (4,), captured attitude, a unit quaternion of either sign.
        model: noise of the pose. If a number of the pose is not finite, the belief is unchanged.
    """
    observed = jnp.all(jnp.isfinite(pos)) & jnp.all(jnp.isfinite(quat_wxyz))
    mean, P = state.mean, state.covariance
    pose = dataclasses.replace(
        mean,
        pos=jnp.where(observed, pos, mean.pos),
        quat_wxyz=jnp.where(observed, quat_wxyz, mean.quat_wxyz),
    )
    residual = difference(mean, pose)[:6]
    stds = jnp.stack([jnp.asarray(std, P.dtype) for std in (model.pos_std, model.attitude_std)])
    R = jnp.diag(jnp.repeat(stds**2, 3))
    factor = cho_factor(P[:6, :6] + R, lower=True)
    K = cho_solve(factor, P[:6]).T
    error = jnp.matmul(K, residual, precision=_HIGHEST)
    new = retract(mean, error)
    # The corrected error is stated in the frame of the corrected mean.
    turn = jax.jacfwd(lambda e: difference(new, retract(mean, error + e)))(jnp.zeros_like(error))
    gain = jnp.eye(15, dtype=P.dtype) - jnp.pad(K, ((0, 0), (0, 9)))
    spread = congruence(turn, congruence(gain, P) + congruence(K, R))
    log_density = -0.5 * (
        jnp.sum(residual * cho_solve(factor, residual)) + 6.0 * math.log(2.0 * math.pi)
    ) - jnp.sum(jnp.log(jnp.diagonal(factor[0])))
    after = RobotFilterState(new, spread, state.log_likelihood + log_density)
    return jax.tree.map(lambda new, old: jnp.where(observed, new, old), after, state)
