"""Penalty shapes, quadrature weights, and how far limits are exceeded."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.cost import quadrotor
from planner_jax.cost.penalty import (
    apex_excess,
    hitting_speed_excess,
    join_trapezoid_weights,
    smooth_hinge,
    trapezoid_weights,
)
from planner_jax.penalties import steep_hinge, thrust_band_excess

WIDTH = 0.1
GRAVITY = 9.8

float64 = pytest.mark.usefixtures("float64")

SHAPES = {"smooth": smooth_hinge, "steep": steep_hinge}


@jax.jit
def penalties(x, width):
    found = {}
    for name, shape in SHAPES.items():
        slope = jax.grad(shape)
        found[name] = shape(x, width), slope(x, width), jax.grad(slope)(x, width)
    return found


def value_slope_bend(name, points, width=WIDTH):
    return np.array([penalties(x, width)[name] for x in points]).T


@float64
def test_the_smooth_hinge_is_zero_then_a_quartic_then_a_line():
    x = np.array([-1.0, 0.0, 0.05, 0.1, 0.3])
    value, slope, _ = value_slope_bend("smooth", x)
    blend = (WIDTH - 0.025) * 0.5**3
    np.testing.assert_allclose(value, [0.0, 0.0, blend, 0.05, 0.25], atol=1e-16)
    np.testing.assert_allclose(slope, [0.0, 0.0, 0.5, 1.0, 1.0], atol=1e-14)


@float64
def test_the_smooth_hinge_is_twice_differentiable_never_falls_and_is_never_concave():
    for joint in (0.0, WIDTH):
        before, after = np.transpose(value_slope_bend("smooth", joint + np.array([-1e-9, 1e-9])))
        np.testing.assert_allclose(before, after, atol=1e-6)
    value, slope, bend = value_slope_bend("smooth", np.linspace(-0.0495, 0.2505, 301))
    assert np.all(value >= 0.0) and np.all(slope >= 0.0) and np.all(bend >= -1e-12)
    np.testing.assert_allclose(np.max(bend), 1.5 / WIDTH, rtol=1e-3)


@float64
def test_the_steep_hinge_is_as_printed_and_loses_its_slope_at_the_joint():
    x = np.array([-1.0, 0.0, 0.06, 0.1, 0.3])
    printed = [0.0, 0.0, 0.06**3, 1e-3, 1e-3 + 0.2**2 * 0.3 / 1e-4]
    np.testing.assert_allclose(value_slope_bend("steep", x)[0], printed, rtol=1e-12)
    value, slope, _ = value_slope_bend("steep", WIDTH + np.array([-1e-12, 1e-12]))
    np.testing.assert_allclose(value, WIDTH**3, atol=1e-12)
    np.testing.assert_allclose(slope, [3.0 * WIDTH**2, 0.0], atol=1e-8)


@float64
def test_thrust_exceeds_its_band_by_the_products_of_its_distances_from_both_limits():
    thrust = np.array([2.0, 4.0, GRAVITY, 20.0, 25.0])  # the limits are 4 and 20 m/s^2
    direction = np.array([0.6, 0.0, 0.8])
    acc = thrust[:, None] * direction - np.array([0.0, 0.0, GRAVITY])
    excess = thrust_band_excess(acc, GRAVITY, 4.0, 20.0)
    np.testing.assert_allclose(excess, (thrust - 4.0) * (thrust - 20.0), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_penalties_and_their_slopes_are_finite_and_not_negative_in_float32(name):
    x = np.array([-1e6, -WIDTH, 0.0, 1e-20, WIDTH, 1e3], np.float32)
    value, slope, _ = value_slope_bend(name, x, np.float32(WIDTH))
    assert value.dtype == slope.dtype == np.float32
    assert np.all(np.isfinite(value)) and np.all(np.isfinite(slope))
    assert np.all(value >= 0.0) and np.all(slope >= 0.0)


@pytest.mark.parametrize("num", [1, 2, 7])
def test_the_trapezoid_rule_integrates_lines_exactly(num):
    weights, x = trapezoid_weights(num), np.linspace(0.0, 1.0, num + 1)
    assert weights.dtype == np.float64
    assert np.sum(weights) == pytest.approx(1.0, rel=1e-15)
    assert weights @ (3.0 * x - 5.0) == pytest.approx(-3.5, rel=1e-14)


def test_joined_weights_are_those_of_the_pieces_with_shared_ends_added():
    separate, shares = np.zeros(13), (0.5, 1.0, 1.5)
    for piece in range(3):
        separate[4 * piece : 4 * piece + 5] += shares[piece] * trapezoid_weights(4)
    np.testing.assert_allclose(join_trapezoid_weights(4, shares), separate, rtol=1e-15)


# Functions that scale a motion by k and return how far it exceeds a limit: 0 at k = 1.
ACC, JERK = np.array([10.0, -5.0, 10.0]), np.array([0.0, 4.0 * GRAVITY, 0.0])
AT_LIMIT = {
    "speed": lambda k: quadrotor.speed_excess(k * np.array([3.0, 0.0, 4.0]), 5.0),
    "acceleration": lambda k: quadrotor.acceleration_excess(k * ACC, 15.0),
    # 2 sin^2(theta / 2) = 1 - cos(theta) = k^2 / 2, and the limit is 60 degrees.
    "tilt": lambda k: quadrotor.tilt_excess(
        3.0 * jnp.array([jnp.sqrt(k**2 - 0.25 * k**4), 0.0, 1.0 - 0.5 * k**2])
        - np.array([0.0, 0.0, GRAVITY]),
        GRAVITY,
        np.pi / 3.0,
    ),
    "body rate": lambda k: quadrotor.body_rate_excess(np.zeros(3), k * JERK, GRAVITY, 4.0),
}


@float64
@pytest.mark.parametrize("name", AT_LIMIT)
def test_the_excess_is_zero_at_the_limit_and_the_square_of_the_share_less_one(name):
    shares = np.array([0.0, 0.5, 1.0, 2.0])
    excess = jax.jit(jax.vmap(AT_LIMIT[name]))(shares)
    np.testing.assert_allclose(excess, shares**2 - 1.0, atol=1e-14)
    np.testing.assert_allclose(quadrotor.relative(excess), shares - 1.0, atol=1e-6)


def test_the_ground_is_exceeded_in_metres_from_below():
    excess = quadrotor.ground_excess(np.array([1.0, 0.25, 0.0, -1.0]), 0.25)
    np.testing.assert_allclose(excess, [-0.75, 0.0, 0.25, 1.25])


def test_gradients_are_finite_at_zero_speed_in_hover_and_near_free_fall():
    still = np.zeros(3, np.float32)
    fall = np.array([0.0, 0.0, -GRAVITY], np.float32)

    def total(vel, acc, jerk):
        squares = [quadrotor.speed_excess(vel, 5.0), quadrotor.acceleration_excess(acc, 15.0)]
        squares.append(quadrotor.body_rate_excess(acc, jerk, GRAVITY, 4.0))
        return sum(squares) + sum(map(quadrotor.relative, squares))

    gradient = jax.jit(jax.grad(total, argnums=(0, 1, 2)))
    for acc in (still, fall, fall + np.float32(1e-4)):
        assert all(np.all(np.isfinite(leaf)) for leaf in gradient(still, acc, still))


@float64
def test_apex_and_hitting_speed_are_exceeded_relative_to_their_bounds():
    low, high = apex_excess(np.array([1.1, 2.2, 3.0, 6.2, 9.3]), 2.2, 6.2)
    np.testing.assert_allclose(low, [0.5, 0.0, -0.8 / 2.2, -4.0 / 2.2, -7.1 / 2.2], atol=1e-15)
    np.testing.assert_allclose(high, [-5.1 / 6.2, -4.0 / 6.2, -3.2 / 6.2, 0.0, 0.5], atol=1e-15)
    excess = hitting_speed_excess(np.array([-4.0, 6.0, 0.0]), np.array([4.0, 3.0, 4.0]))
    np.testing.assert_allclose(excess, [0.0, 3.0, -1.0], atol=1e-15)  # each axis has its own limit
