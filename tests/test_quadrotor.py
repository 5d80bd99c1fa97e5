"""Quadrotor flatness: thrust, attitude and body rate by the Hopf fibration."""

import jax
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences

from planner_jax.robot.quadrotor import (
    QuadrotorLimits,
    body_rate_squared,
    body_z,
    net_thrust,
    tangent_basis,
)

GRAVITY = 9.8
# An acceleration polynomial (3 axes) that tilts the quadrotor far and turns it about its thrust.
MOTION = np.array([[2.0, -3.0, 1.5, 4.0], [-4.0, 6.0, 2.0, -1.0], [1.0, 2.0, -6.0, 3.0]])

float64 = pytest.mark.usefixtures("float64")

rate_squared = jax.jit(body_rate_squared)
axis = jax.jit(body_z)
basis = jax.jit(jax.vmap(tangent_basis))
rate_and_gradient = jax.jit(jax.value_and_grad(body_rate_squared, argnums=(0, 1)))


def acceleration(time, order=0):
    return np.array([np.polynomial.Polynomial(row).deriv(order)(time) for row in MOTION])


def hopf_rotation(z):
    """Attitude of the Hopf fibration at zero heading, of the quaternion (1 + z_z, -z_y, z_x, 0)."""
    w, x, y = np.array([1.0 + z[2], -z[1], z[0]]) / np.sqrt(2.0 * (1.0 + z[2]))
    return np.array(
        [
            [1.0 - 2.0 * y * y, 2.0 * x * y, 2.0 * w * y],
            [2.0 * x * y, 1.0 - 2.0 * x * x, -2.0 * w * x],
            [-2.0 * w * y, 2.0 * w * x, 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def attitude(time):
    thrust = acceleration(time) + [0.0, 0.0, GRAVITY]
    return hopf_rotation(thrust / np.linalg.norm(thrust))


def unit_vectors(num=50):
    vectors = np.random.default_rng(0).normal(size=(num, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


# Thrust


@float64
def test_the_thrust_carries_the_weight_and_the_body_axis_follows_it():
    acc = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0 - GRAVITY], [0.0, 0.0, -2.0 * GRAVITY]])
    np.testing.assert_allclose(net_thrust(acc, GRAVITY), acc + [0.0, 0.0, GRAVITY], rtol=1e-15)
    expected = [[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.0, -1.0]]
    np.testing.assert_allclose(axis(acc, GRAVITY), expected, atol=1e-15)


def test_in_free_fall_the_body_axis_is_zero_with_a_finite_gradient():
    fall = np.array([0.0, 0.0, -GRAVITY], np.float32)
    assert not np.any(axis(fall[None], GRAVITY))
    jacobian = jax.jit(jax.jacfwd(body_z))(fall, np.float32(GRAVITY))
    assert np.all(np.isfinite(jacobian))


# Attitude


@float64
def test_the_basis_and_the_normal_are_a_right_handed_frame():
    normals = unit_vectors()
    x, y = basis(normals)
    frames = np.stack([x, y, normals], axis=-1)
    np.testing.assert_allclose(
        np.swapaxes(frames, 1, 2) @ frames, np.tile(np.eye(3), (50, 1, 1)), atol=1e-13
    )
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, rtol=1e-13)


@float64
def test_the_basis_is_the_hopf_attitude_of_zero_heading():
    normals = unit_vectors()
    x, y = basis(normals)
    for k, normal in enumerate(normals):
        frame = np.stack([x[k], y[k], normal], axis=1)
        np.testing.assert_allclose(frame, hopf_rotation(normal), atol=1e-13)


def test_the_basis_is_level_in_hover_and_finite_straight_down():
    x, y = basis(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], np.float32))
    np.testing.assert_array_equal([x[0], y[0]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert np.all(np.isfinite(x)) and np.all(np.isfinite(y))


# Body rate


@float64
@pytest.mark.parametrize("time", [0.0, 0.3, 0.7, 1.1])
def test_the_body_rate_is_that_of_the_turning_attitude(time):
    """omega^ = R^T dR/dt, with central differences of R."""
    step = 1e-5
    turning = attitude(time).T @ (attitude(time + step) - attitude(time - step)) / (2.0 * step)
    np.testing.assert_allclose(turning, -turning.T, atol=1e-8)
    omega = np.array([turning[2, 1], turning[0, 2], turning[1, 0]])
    squared = rate_squared(acceleration(time), acceleration(time, 1), GRAVITY)
    np.testing.assert_allclose(squared, omega @ omega, rtol=1e-8)


@float64
def test_in_hover_the_body_rate_is_the_jerk_across_the_thrust_over_gravity():
    jerk = np.array([3.0, -4.0, 7.0])
    squared = rate_squared(np.zeros(3), jerk, GRAVITY)
    np.testing.assert_allclose(squared, (5.0 / GRAVITY) ** 2, rtol=1e-14)


@float64
def test_jerk_along_the_thrust_does_not_turn_the_body():
    acc = np.array([3.0, -2.0, 1.0])
    assert rate_squared(acc, 5.0 * (acc + [0.0, 0.0, GRAVITY]), GRAVITY) < 1e-13


@float64
def test_the_body_rate_grows_with_the_jerk_alone_in_proportion():
    acc, jerk = acceleration(0.5), acceleration(0.5, 1)
    doubled = rate_squared(acc, 2.0 * jerk, GRAVITY)
    np.testing.assert_allclose(doubled, 4.0 * rate_squared(acc, jerk, GRAVITY), rtol=1e-14)


@float64
def test_the_body_rate_is_never_below_the_rate_at_which_the_thrust_tilts():
    rng = np.random.default_rng(1)
    acc, jerk = rng.normal(scale=6.0, size=(2, 5, 4, 3))
    thrust = acc + [0.0, 0.0, GRAVITY]
    across = np.cross(thrust, jerk)
    tilt_squared = np.sum(across**2, axis=-1) / np.sum(thrust**2, axis=-1) ** 2
    squared = rate_squared(acc, jerk, GRAVITY)
    assert squared.shape == (5, 4)
    assert np.all(squared >= tilt_squared * (1.0 - 1e-12))


def rate_of(point):
    return body_rate_squared(*point)


@float64
@pytest.mark.parametrize("acc", [(0.0, 0.0, 0.0), (3.0, -5.0, 2.0), (4.0, 1.0, -12.0)])
def test_the_gradient_of_the_body_rate_matches_finite_differences(acc):
    """In hover, tilted, and with the thrust pointing down."""
    point = (np.array(acc), np.array([20.0, -7.0, 11.0]), GRAVITY)
    assert_gradient_matches_differences(rate_of, point, rtol=1e-6)


# In hover; near and in free fall; near and at straight down.
@pytest.mark.parametrize(
    "thrust", [(0, 0, GRAVITY), (1e-4, 0, 1e-5), (0, 0, 0), (1e-3, 0, -5.0), (0, 0, -5.0)]
)
@pytest.mark.parametrize("jerk", [(0.0, 0.0, 0.0), (30.0, -20.0, 10.0)])
def test_value_and_gradient_are_finite_wherever_the_thrust_points(thrust, jerk):
    acc = np.array(thrust, np.float32) - np.array([0.0, 0.0, GRAVITY], np.float32)
    value, gradient = rate_and_gradient(acc, np.array(jerk, np.float32), np.float32(GRAVITY))
    assert np.isfinite(value) and value >= 0.0
    assert all(np.all(np.isfinite(leaf)) for leaf in gradient)


def test_the_body_rate_is_right_to_rounding_in_float32(float64):
    rng = np.random.default_rng(2)
    acc, jerk = rng.normal(scale=6.0, size=(2, 5, 4, 3)).astype(np.float32)
    exact = rate_squared(acc.astype(np.float64), jerk.astype(np.float64), GRAVITY)
    single = rate_squared(acc, jerk, np.float32(GRAVITY))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, exact, rtol=2e-5)


def test_scaled_limits_keep_the_ground():
    limits = QuadrotorLimits(speed=5.0, acceleration=15.0, body_rate=4.0, min_height=0.25)
    half = limits.scale(0.5, 9.81)
    assert (half.speed, half.acceleration, half.body_rate) == (2.5, 7.5, 2.0)
    assert half.min_height == limits.min_height
    assert limits.speed == 5.0
