import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.trajectory import bezier
from planner_jax.trajectory.bezier import BezierCurve, bernstein, hodograph

PIECES, DEGREE, HORIZON = 4, 5, 3.0
POINTS = np.random.default_rng(0).normal(size=(PIECES, DEGREE + 1))
TIMES = np.linspace(0.0, HORIZON, 41)[:-1] + 0.01
float64 = pytest.mark.usefixtures("float64")


def of_polynomial(polynomial):
    shares = np.linspace(0.0, 1.0, DEGREE + 1)
    starts = np.arange(PIECES)[:, None]
    values = polynomial((starts + shares) * HORIZON / PIECES)
    return np.linalg.solve(bernstein(DEGREE, shares), values.T).T


@jax.jit
def values(points, times):
    curve = BezierCurve(points=points, horizon=jnp.asarray(HORIZON, points.dtype))
    both = [jax.vmap(jax.value_and_grad(lambda t, k=k: curve.at(t, k)))(times) for k in range(4)]
    return tuple(jnp.stack(each) for each in zip(*both, strict=True))


@float64
def test_a_curve_of_a_polynomials_points_is_that_polynomial_with_all_its_derivatives():
    polynomial = np.polynomial.Polynomial([0.3, -1.0, 0.5, 0.2, -0.1, 0.02])
    value, slope = values(of_polynomial(polynomial), TIMES)
    for order in range(4):
        expected = polynomial.deriv(order)(TIMES) if order else polynomial(TIMES)
        np.testing.assert_allclose(value[order], expected, atol=1e-9)
    np.testing.assert_allclose(slope[:3], value[1:], atol=1e-9)


@float64
def test_points_of_a_polynomial_join_up_to_every_derivative_and_others_do_not():
    smooth = of_polynomial(np.polynomial.Polynomial([1.0, 2.0, -0.5, 0.1, 0.3, -0.05]))
    rows = bezier.joints(DEGREE, 3, PIECES)
    assert rows.shape == ((PIECES - 1) * 4, PIECES * (DEGREE + 1))
    np.testing.assert_allclose(rows @ smooth.ravel(), 0.0, atol=1e-9)
    assert np.abs(rows @ POINTS.ravel()).min() > 1e-3


@float64
def test_the_curve_lies_between_its_points_and_ends_at_the_first_and_the_last():
    times = np.append(TIMES[1:-1], [0.0, HORIZON])
    value = np.asarray(values(POINTS, times)[0][0])
    piece = np.minimum((times / HORIZON * PIECES).astype(int), PIECES - 1)
    least, most = POINTS.min(axis=1)[piece], POINTS.max(axis=1)[piece]
    assert (value <= most + 1e-12).all() and (value >= least - 1e-12).all()
    np.testing.assert_allclose(value[-2:], POINTS[[0, -1], [0, -1]], atol=1e-12)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_energy_is_the_integral_of_the_squared_derivative(order):
    nodes, weights = np.polynomial.legendre.leggauss(8)
    basis = bernstein(DEGREE - order, 0.5 + 0.5 * nodes)
    values = POINTS @ (basis @ hodograph(DEGREE, order, PIECES)).T
    integral = np.sum(values**2 @ weights) / (2 * PIECES)
    form = bezier.energy_of_pieces(DEGREE, order, PIECES)
    np.testing.assert_allclose(POINTS.ravel() @ form @ POINTS.ravel(), integral, rtol=1e-12)


def test_rows_and_bounds_of_pieces_share_one_row_at_each_joint_with_both_bounds():
    of_piece = np.eye(DEGREE + 1)
    rows = bezier.rows_of_pieces(of_piece, PIECES)
    smooth = of_polynomial(np.polynomial.Polynomial([0.0, 1.0, 1.0]))
    value = rows @ smooth.ravel()
    assert len(value) == PIECES * DEGREE + 1
    bounds_at = smooth + np.array([0.0, 0.1, 0.0, 0.3])[:, None]
    bounds_at = jnp.asarray(bounds_at)
    low, high = map(np.asarray, bezier.bounds_of_pieces(bounds_at, bounds_at))
    assert low.shape == high.shape == value.shape
    places = np.arange(1, PIECES) * DEGREE
    np.testing.assert_allclose((low - value)[places], [0.1, 0.1, 0.3], atol=1e-6)
    np.testing.assert_allclose((high - value)[places], [0.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose((low - value)[[1, 6, 11, -1]], [0.0, 0.1, 0.0, 0.3], atol=1e-6)
