import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences
from scipy.interpolate import BSpline

from planner_jax.baselines.block.b_spline import b_spline, basis, hodograph
from planner_jax.trajectory.polynomial import evaluate

SHARES = np.linspace(0.0, 1.0, 98)
DURATION = 0.6
# (degree, number of control points) of curves with one or several spans.
SIZES = [(1, 4), (2, 3), (3, 4), (3, 7), (5, 9)]
every_size = pytest.mark.parametrize("degree, num", SIZES)


def control_points(num):
    return np.random.default_rng(num).normal(size=(num, 6))


def scipy_curve(degree, points):
    """Return SciPy's clamped uniform B-spline with these control points, a function on [0, 1]."""
    inner = np.linspace(0.0, 1.0, len(points) - degree + 1)
    return BSpline(np.r_[[0.0] * degree, inner, [1.0] * degree], points, degree)


@functools.partial(jax.jit, static_argnums=(0, 3))
def sample(degree, points, duration, order):
    trajectory = b_spline(degree, points, duration)
    times = jnp.asarray(SHARES, points.dtype) * duration
    return jax.vmap(lambda time: evaluate(trajectory, time, order))(times)


@every_size
def test_the_basis_is_a_partition_of_unity_and_gives_the_curve(degree, num):
    points, values = control_points(num), basis(degree, num, SHARES)
    np.testing.assert_allclose(values @ points, scipy_curve(degree, points)(SHARES), atol=1e-12)
    assert (values >= 0.0).all()
    np.testing.assert_allclose(values.sum(axis=-1), 1.0, atol=1e-14)
    np.testing.assert_array_equal(basis(degree, num, np.arange(2)), np.eye(num)[[0, -1]])
    # The curve parameter may be a single number or an array of any shape.
    single, grid = basis(degree, num, 0.3), basis(degree, num, np.full((1, 1), 0.3))
    np.testing.assert_allclose(single, grid[0, 0])


@every_size
def test_a_derivative_is_the_spline_of_the_hodograph_between_whose_points_it_lies(degree, num):
    points = control_points(num)
    for order in range(1, degree + 1):
        of_derivative = hodograph(degree, order, num) @ points
        value = basis(degree - order, num - order, SHARES) @ of_derivative
        expected = scipy_curve(degree, points)(SHARES, order)[:-1]
        scale = np.abs(expected).max()
        np.testing.assert_allclose(value[:-1], expected, atol=1e-12 * scale)
        assert (value <= of_derivative.max(axis=0) + 1e-12 * scale).all()
        assert (value >= of_derivative.min(axis=0) - 1e-12 * scale).all()


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_as_a_piecewise_polynomial_it_is_the_same_curve_with_its_derivatives(order, float64):
    points = control_points(7)
    value = sample(3, points, DURATION, order)
    expected = scipy_curve(3, points)(SHARES, order) / DURATION**order
    np.testing.assert_allclose(value, expected, atol=1e-10 * np.abs(expected).max())


def test_every_span_is_a_piece_of_equal_duration_and_of_the_type_of_the_points():
    trajectory = b_spline(3, jnp.asarray(control_points(7), jnp.float32), DURATION)
    assert trajectory.coeffs.shape == (4, 4, 6)
    assert trajectory.coeffs.dtype == trajectory.durations.dtype == jnp.float32
    np.testing.assert_allclose(trajectory.durations, DURATION / 4, rtol=1e-6)


def test_the_curve_is_exact_to_rounding_in_float32():
    points = control_points(7).astype(np.float32)
    value = sample(3, points, np.float32(DURATION), 0)
    np.testing.assert_allclose(value, scipy_curve(3, points)(SHARES), atol=2e-6)


def test_gradients_by_control_points_and_duration_match_differences(float64):
    weights = np.random.default_rng(0).normal(size=(3, len(SHARES), 6))

    def total(point):
        return sum(jnp.sum(each * sample(3, *point, order)) for order, each in enumerate(weights))

    assert_gradient_matches_differences(total, (control_points(7), DURATION))


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: basis(3, 3, 0.5), "control points must be more than the degree 3, got 3"),
        (lambda: hodograph(2, 1, 1), "control points must be more than the degree 2, got 1"),
        (lambda: b_spline(3, np.zeros((2, 6)), 1.0), "control points must be more than the degree"),
        (lambda: basis(3, 5, np.array([0.5, 1.25, 1.1])), "shares must be from 0 to 1, got 1.25"),
        (lambda: basis(3, 5, np.nan), "shares must be from 0 to 1, got nan"),
    ],
)
def test_invalid_splines_are_rejected_in_one_line(call, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        call()
