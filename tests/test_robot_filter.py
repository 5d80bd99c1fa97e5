"""The error-state Kalman filter of a quadrotor, against exact rigid-body motions."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from scipy.spatial.transform import Rotation
from serve import GRAVITY, assert_close, float64, pick

from planner_jax.perception import (
    BALL_FILTER,
    ROBOT_FILTER,
    BodyState,
    RobotFilterModel,
    difference,
    retract,
)

PERIOD, NUM, EVERY = 0.004, 400, 2  # [s] and number of IMU samples; a pose after every second one
STDS = {
    "pos_std": 0.1,
    "attitude_std": 0.1,
    "vel_std": 0.5,
    "rate_bias_std": 0.02,
    "force_bias_std": 0.2,
}
SPREAD = np.repeat(list(STDS.values()), 3)
# Densities of gyroscope and accelerometer at 250 Hz: 0.01 rad/s and 0.1 m/s^2.
NOISY = RobotFilterModel(GRAVITY, 4e-7, 4e-5, 1e-6, 1e-4, 0.002, 0.005)
EXACT = RobotFilterModel(GRAVITY, *[1e-16] * 4, 1e-6, 1e-6)


def as_type(tree, dtype=np.float64):
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype), tree)


def body(pos=(0.0,) * 3, vel=(0.0,) * 3, turn=(0.0,) * 3):
    quat = Rotation.from_rotvec(turn).as_quat(scalar_first=True)
    return as_type(BodyState(np.array(pos), quat, np.array(vel), np.zeros(3), np.zeros(3)))


@functools.cache
def motion():
    """Return specific forces, body rates and exact states of a flight, by matrix exponentials."""
    t = PERIOD * np.arange(NUM)
    rate = np.stack([3.0 * np.sin(5.0 * t), 2.0 * np.cos(4.0 * t), 0.5 + 0.0 * t], axis=1)
    force = np.stack([0.3 * np.sin(9.0 * t), 0.2 * np.cos(7.0 * t), 9.8 + 4.0 * np.sin(6.0 * t)], 1)
    twist = np.zeros((NUM, 5, 5))
    twist[:, :3, :3] = np.cross(np.eye(3)[None], rate[:, None])
    twist[:, :3, 3], twist[:, 3, 4] = force, 1.0
    steps = scipy.linalg.expm(PERIOD * twist)
    fall, state, path = np.array([0.0, 0.0, -GRAVITY]), np.eye(5), []
    for step in steps:
        state = state @ step
        state[:3, 4] += 0.5 * PERIOD**2 * fall
        state[:3, 3] += PERIOD * fall
        path.append(state)
    path = np.array(path)
    quat = Rotation.from_matrix(path[:, :3, :3]).as_quat(scalar_first=True)
    zero = np.zeros((NUM, 3))
    return force, rate, BodyState(path[:, :3, 4], quat, path[:, :3, 3], zero, zero)


def run_filter(start, force, rate, pos, quat, model):
    state = ROBOT_FILTER.init(start, **as_type(STDS, pos.dtype))

    def advance(state, now):
        force, rate, pos, quat = now
        state = ROBOT_FILTER.predict(state, force, rate, np.asarray(PERIOD, pos.dtype), model)
        return ROBOT_FILTER.update(state, pos, quat, model), None

    return jax.lax.scan(advance, state, (force, rate, pos, quat))[0]


difference_many = jax.jit(jax.vmap(difference))
run_many = jax.jit(jax.vmap(run_filter, in_axes=(0, 0, 0, 0, 0, None)))


def simulate(num, model, seed=0, dtype=np.float64):
    """Return starts, measurements of IMU and poses of `num` flights, and the last true states."""
    force, rate, path = motion()
    rng = np.random.default_rng(seed)

    def noise(density, *shape):
        return np.sqrt(density) * rng.normal(size=(num, *shape, 3))

    first = SPREAD * rng.normal(size=(num, 15))
    walks = [
        first[:, None, at : at + 3] + np.cumsum(noise(density * PERIOD, NUM), axis=1)
        for at, density in ((9, model.rate_bias_density), (12, model.force_bias_density))
    ]
    starts = jax.jit(jax.vmap(retract, (None, 0)))(body(), -first)
    starts = dataclasses.replace(
        starts, rate_bias=0.0 * first[:, :3], force_bias=0.0 * first[:, :3]
    )
    rates = rate + walks[0] + noise(model.rate_density / PERIOD, NUM)
    forces = force + walks[1] + noise(model.force_density / PERIOD, NUM)
    turned = Rotation.from_quat(np.tile(path.quat_wxyz, (num, 1)), scalar_first=True)
    turned = turned * Rotation.from_rotvec(noise(model.attitude_std**2, NUM).reshape(-1, 3))
    quat = turned.as_quat(scalar_first=True).reshape(num, NUM, 4)
    pos = path.pos + noise(model.pos_std**2, NUM)
    pos[:, ::EVERY] = np.nan
    last = jax.tree.map(lambda leaf: np.repeat(leaf[-1:], num, axis=0), path)
    last = dataclasses.replace(last, rate_bias=walks[0][:, -1], force_bias=walks[1][:, -1])
    return as_type((starts, forces, rates, pos, quat, model), dtype), as_type(last, dtype)


@float64
def test_without_noise_the_estimate_becomes_exact():
    given, last = simulate(20, EXACT)
    state = run_many(*given)
    assert np.abs(difference_many(state.mean, last)).max() < 1e-5


@float64
@pytest.mark.parametrize("num", [20, pytest.param(100, marks=pytest.mark.slow)])
def test_the_normalised_error_is_in_its_band(num):
    given, last = simulate(num, as_type(NOISY), seed=num)
    state = run_many(*given)
    error = np.asarray(difference_many(state.mean, last))
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(state.covariance), error)
    low, high = scipy.stats.chi2.interval(0.95, 15 * num)
    assert low < squares.sum() < high


def test_the_covariance_stays_positive_definite_in_float32():
    given, last = simulate(4, NOISY, dtype=np.float32)
    state = run_many(*given)
    scale = np.sqrt(np.diagonal(state.covariance, axis1=1, axis2=2))
    correlation = state.covariance / scale[:, :, None] / scale[:, None]
    assert np.linalg.eigvalsh(correlation).min() > 0.0
    assert np.abs(difference_many(state.mean, last)[:, :6]).max() < 0.02


@float64
def test_a_missing_pose_leaves_the_belief_and_batch_equals_loop():
    def one(start, force, rate, pos, quat):
        state = ROBOT_FILTER.init(start, **as_type(STDS))
        state = ROBOT_FILTER.predict(state, force, rate, PERIOD, as_type(NOISY))
        return state, ROBOT_FILTER.update(state, pos, quat, as_type(NOISY))

    start, *seen = simulate(2, NOISY)[0][:-1]
    given = (start, *(each[:, k] for k, each in enumerate(seen)))
    many, single = jax.jit(jax.vmap(one))(*given), jax.jit(one)
    for k in range(2):
        assert_close(pick(many, k), single(*pick(given, k)), rtol=1e-9, atol=1e-15)
    assert_close(*single(*pick(given, 0)[:3], np.full(3, np.nan), given[4][0]), rtol=1e-12)


@float64
def test_the_log_likelihood_is_the_density_of_the_residual():
    state = ROBOT_FILTER.init(body(turn=(0.2, -0.4, 0.6)), **as_type(STDS))
    shift = np.array([0.1, -0.2, 0.05, 0.03, 0.02, -0.1])
    seen = retract(state.mean, np.append(shift, np.zeros(9)))
    density = scipy.stats.multivariate_normal(cov=np.diag([0.01 + 4e-6] * 3 + [0.01 + 25e-6] * 3))
    for sign in (1.0, -1.0):  # both quaternions of an attitude
        after = ROBOT_FILTER.update(state, seen.pos, sign * seen.quat_wxyz, as_type(NOISY))
        np.testing.assert_allclose(after.log_likelihood, density.logpdf(shift), rtol=1e-9)
        np.testing.assert_allclose(difference(after.mean, seen)[:6], 0.0, atol=1e-3)


@float64
def test_without_forces_the_quadrotor_falls_freely():
    state = ROBOT_FILTER.init(body(vel=(1.0, 2.0, 3.0), turn=(0.2, -0.4, 0.6)), **as_type(STDS))
    after = ROBOT_FILTER.predict(state, np.zeros(3), np.ones(3), 0.5, as_type(NOISY)).mean
    np.testing.assert_allclose(after.pos, [0.5, 1.0, 1.5 - GRAVITY / 8.0], atol=1e-12)
    np.testing.assert_allclose(after.vel, [1.0, 2.0, 3.0 - GRAVITY / 2.0], atol=1e-12)
    turn = Rotation.from_rotvec([0.2, -0.4, 0.6]) * Rotation.from_rotvec([0.5] * 3)
    np.testing.assert_allclose(after.quat_wxyz, turn.as_quat(scalar_first=True), atol=1e-12)


@float64
@pytest.mark.parametrize("size", [0.0, 0.5])
def test_derivatives_by_a_pose_agree_with_finite_differences(size):
    state = ROBOT_FILTER.init(body(turn=(0.2, -0.4, 0.6)), **as_type(STDS))

    @jax.jit
    @jax.vmap
    @jax.value_and_grad
    def likelihood(x):
        pose = retract(state.mean, jnp.concatenate([x, jnp.zeros(9)]))
        return ROBOT_FILTER.update(state, pose.pos, pose.quat_wxyz, as_type(NOISY)).log_likelihood

    at, step = size * np.arange(1.0, 7.0) / 6.0, 1e-5
    values, gradients = likelihood(at + step * np.vstack([np.eye(6), -np.eye(6), np.zeros(6)]))
    np.testing.assert_allclose(
        gradients[12], (values[:6] - values[6:12]) / (2.0 * step), rtol=1e-5, atol=1e-6
    )


def test_both_filters_have_the_same_functions():
    for each in (BALL_FILTER, ROBOT_FILTER):
        assert [f.__name__.split("_")[-1] for f in each] == list(each._fields)
