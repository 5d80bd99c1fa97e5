"""The minimum-jerk primitive: its ends, its cost, and its optimality."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences

from planner_jax.baselines.parts.minimum_jerk import minimum_jerk, primitive_cost
from planner_jax.trajectory.polynomial import snap_energy

DURATION = 0.9
HEAD = np.array([[1.0, -2.0, 1.5], [0.5, 2.0, -1.0], [3.0, -4.0, 2.0]])
TAIL = np.array([[0.2, 1.0, 2.5], [-1.5, 0.0, 3.0], [-2.0, 5.0, 1.0]])

float64 = pytest.mark.usefixtures("float64")


@jax.jit
def solve(head_state, tail_state, duration):
    primitive = minimum_jerk(head_state, tail_state, duration)
    return primitive, snap_energy(primitive, 3) / duration


def axes_of(coeffs):
    return [np.polynomial.Polynomial(c) for c in np.asarray(coeffs, np.float64).T]


def jerk_cost(axes):
    """Compute (1/T) integral |jerk|^2 dt by Gauss's quadrature, exact up to degree 31."""
    nodes, weights = np.polynomial.legendre.leggauss(16)
    times = 0.5 * DURATION * (1.0 + nodes)
    return sum(0.5 * weights @ axis.deriv(3)(times) ** 2 for axis in axes)


def states(axes):
    rows = [[axis.deriv(d) if d else axis for axis in axes] for d in range(3)]
    return np.array([[[p(time) for p in row] for row in rows] for time in (0.0, DURATION)])


@float64
def test_the_primitive_meets_both_states():
    primitive, _ = solve(HEAD, TAIL, DURATION)
    assert primitive.coeffs.shape == (1, 6, 3)
    np.testing.assert_array_equal(primitive.durations, [DURATION])
    head, tail = states(axes_of(primitive.coeffs[0]))
    np.testing.assert_allclose(head, HEAD, atol=1e-14)
    np.testing.assert_allclose(tail, TAIL, atol=1e-11)


@float64
def test_from_hover_to_hover_it_is_the_classical_quintic():
    """A move d in time T is (10 x^3 - 15 x^4 + 6 x^5) d, x = t / T, with cost 720 |d|^2 / T^6."""
    move, rest = np.array([2.0, -1.0, 0.5]), np.zeros((3, 3))
    primitive, cost = solve(rest, np.concatenate([move[None], rest[1:]]), DURATION)
    shape = np.array([0.0, 0.0, 0.0, 10.0, -15.0, 6.0]) / DURATION ** np.arange(6)
    np.testing.assert_allclose(primitive.coeffs[0], np.outer(shape, move), atol=1e-12)
    np.testing.assert_allclose(cost, 720.0 * move @ move / DURATION**6, rtol=1e-12)


@float64
def test_the_cost_is_the_mean_squared_jerk_and_every_change_raises_it():
    primitive, cost = solve(HEAD, TAIL, DURATION)
    axes = axes_of(primitive.coeffs[0])
    np.testing.assert_allclose(cost, jerk_cost(axes), rtol=1e-12)
    assert all(axis.degree() == 5 and not axis.deriv(6).coef.any() for axis in axes)
    # Added multiples of t^3 (T - t)^3 keep position, velocity and acceleration at both ends.
    polynomial = np.polynomial.Polynomial
    bump = polynomial([0.0, 1.0]) ** 3 * polynomial([DURATION, -1.0]) ** 3
    rng = np.random.default_rng(0)
    for _ in range(5):
        changes = [bump * polynomial(c) for c in rng.normal(scale=9.0, size=(3, 4))]
        np.testing.assert_allclose(states(changes), 0.0, atol=1e-12)
        changed = [axis + change for axis, change in zip(axes, changes, strict=True)]
        np.testing.assert_allclose(jerk_cost(changed) - cost, jerk_cost(changes), rtol=1e-9)
        assert jerk_cost(changed) > cost


@float64
def test_the_closed_form_of_the_cost_is_the_mean_squared_jerk_for_random_ends():
    rng = np.random.default_rng(3)
    heads, tails = rng.normal(scale=3.0, size=(2, 100, 3, 3))
    durations = rng.uniform(0.3, 2.0, size=100)
    primitives, costs = jax.vmap(solve)(heads, tails, durations)
    gamma, beta, alpha = (math.factorial(k) * primitives.coeffs[:, 0, k] for k in (3, 4, 5))
    by_axis = jax.jit(jax.vmap(primitive_cost))(alpha, beta, gamma, durations)
    assert by_axis.shape == (100, 3)
    np.testing.assert_allclose(by_axis.sum(axis=1), costs, rtol=1e-12)


def cost_and_coefficients(point):
    primitive = minimum_jerk(*point)
    return snap_energy(primitive, 3) / point[-1] + jnp.sum(primitive.coeffs**2)


@float64
def test_the_gradient_in_states_and_duration_matches_finite_differences():
    assert_gradient_matches_differences(cost_and_coefficients, (HEAD, TAIL, DURATION))


def test_batch_equals_loop_in_float32():
    heads, tails = (np.stack([x, -2.0 * x, x[::-1]]).astype(np.float32) for x in (HEAD, TAIL))
    durations = np.array([0.9, 0.4, 1.7], np.float32)
    primitives, costs = jax.tree.map(np.asarray, jax.jit(jax.vmap(solve))(heads, tails, durations))
    assert primitives.coeffs.dtype == costs.dtype == np.float32
    _, end = states(axes_of(primitives.coeffs[0, 0]))
    np.testing.assert_allclose(end[0], TAIL[0], atol=1e-5)
    for k in range(3):
        primitive, cost = solve(heads[k], tails[k], durations[k])
        np.testing.assert_allclose(primitives.coeffs[k], primitive.coeffs, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(costs[k], cost, rtol=1e-4)
