"""Piecewise polynomials: evaluation, continuation past the ends, and energy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences

from planner_jax.trajectory import polynomial

DURATIONS = (0.4, 1.1, 0.7)
DEGREE = 5

float64 = pytest.mark.usefixtures("float64")


@jax.jit
def values_at(trajectory, time):
    return tuple(polynomial.evaluate(trajectory, time, order) for order in range(DEGREE + 2))


@jax.jit
def energies_of(trajectory):
    return tuple(polynomial.snap_energy(trajectory, order) for order in range(DEGREE + 2))


def trajectory(dtype=np.float64, seed=0):
    coeffs = np.random.default_rng(seed).normal(size=(3, DEGREE + 1, 3))
    return polynomial.PiecewisePolynomial(coeffs.astype(dtype), np.array(DURATIONS, dtype))


def exact(piece, local, order=0):
    polynomials = map(np.polynomial.Polynomial, trajectory().coeffs[piece].T)
    return [p.deriv(order)(local) if order else p(local) for p in polynomials]


@float64
@pytest.mark.parametrize("order", range(5))
def test_every_piece_is_evaluated_in_its_own_time(order):
    for time, piece, local in ((0.3, 0, 0.3), (0.9, 1, 0.5), (2.0, 2, 0.5)):
        expected = exact(piece, local, order)
        np.testing.assert_allclose(values_at(trajectory(), time)[order], expected, rtol=1e-12)


@float64
def test_a_piece_starts_when_the_previous_one_ends_and_the_outer_ones_continue():
    for time, piece in ((0.0, 0), (0.4, 1), (1.5, 2)):
        found = values_at(trajectory(), time)[0]
        np.testing.assert_array_equal(found, trajectory().coeffs[piece, 0])
    np.testing.assert_allclose(values_at(trajectory(), -0.5)[0], exact(0, -0.5), rtol=1e-12)
    np.testing.assert_allclose(values_at(trajectory(), 3.0)[0], exact(2, 1.5), rtol=1e-12)
    assert not np.any(values_at(trajectory(), 0.3)[DEGREE + 1])
    assert energies_of(trajectory())[DEGREE + 1] == 0.0


@float64
def test_the_slope_in_time_is_the_next_derivative():
    rate_of = jax.jit(jax.jacfwd(lambda time, path: polynomial.evaluate(path, time, 1)))
    for time in (-0.1, 0.2, 1.2, 2.5):
        expected = values_at(trajectory(), time)[2]
        np.testing.assert_allclose(rate_of(time, trajectory()), expected, rtol=1e-12)


@float64
@pytest.mark.parametrize("order", range(5))
def test_the_energy_is_the_quadrature_of_the_squared_derivative(order):
    nodes, weights = np.polynomial.legendre.leggauss(6)
    energy = 0.0
    for piece, duration in enumerate(DURATIONS):
        samples = exact(piece, 0.5 * duration * (1.0 + nodes), order)
        energy += 0.5 * duration * np.sum(weights * np.square(samples))
    np.testing.assert_allclose(energies_of(trajectory())[order], energy, rtol=1e-13)


@float64
def test_the_gradients_match_finite_differences():
    def total(trajectory):
        value = polynomial.evaluate(trajectory, 1.8, 1)
        return polynomial.snap_energy(trajectory, 3) + jnp.sum(value * jnp.arange(1.0, 4.0))

    assert_gradient_matches_differences(total, trajectory())
