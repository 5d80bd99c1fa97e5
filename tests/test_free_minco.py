"""Splines of least energy with free durations, compared with dense systems in double precision."""

import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxpr import assert_full_precision, equations
from test_minco import dense_solution, draw_problem, interpolate

from planner_jax.trajectory.minco import durations_of, minco
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate, snap_energy

double = pytest.mark.usefixtures("float64")


def energy_of(spline):
    return lambda *problem: snap_energy(spline(*problem), len(problem[0]))


def solved(spline):
    """Return coefficients, energy, and the energy's gradient by waypoints and durations."""

    def solve(*problem):
        path = spline(*problem)
        return snap_energy(path, len(problem[0])), path.coeffs

    return jax.jit(jax.value_and_grad(solve, (2, 3), has_aux=True))


def dense_spline(head, tail, waypoints, durations):
    """Solve for all coefficients at once: given values, and continuity of 2s - 2 derivatives."""
    s, size, pieces = len(head), 2 * len(head), len(durations)
    at_end = np.array([[math.perm(k, d) for k in range(size)] for d in range(size - 1)], float)
    matrix, right = jnp.zeros((size * pieces, size * pieces)), jnp.zeros((size * pieces, 3))
    knots, row = np.arange(pieces - 1), s  # unknowns: coefficients of powers of t / T_i
    columns = knots[:, None] * size + np.arange(size)
    for d in range(s):
        matrix = matrix.at[d, d].set(at_end[d, d])
        right = right.at[d].set(head[d] * durations[0] ** d)
        matrix = matrix.at[d - s, -size:].set(at_end[d])
        right = right.at[d - s].set(tail[d] * durations[-1] ** d)
    for d in (None, *range(size - 1)):
        rows, row = row + knots, row + pieces - 1
        matrix = matrix.at[rows[:, None], columns].set(at_end[d or 0][None])
        if d is None:
            right = right.at[rows].set(waypoints)
        else:
            ratios = (durations[:-1] / durations[1:]) ** d
            matrix = matrix.at[rows, columns[:, 0] + size + d].set(-at_end[d, d] * ratios)
    coeffs = jnp.linalg.solve(matrix, right).reshape(pieces, size, 3)
    coeffs = coeffs / durations[:, None, None] ** jnp.arange(size, dtype=float)[None, :, None]
    return PiecewisePolynomial(coeffs=coeffs, durations=durations)


def draw(order, pieces):
    head, tail, steps, durations = draw_problem(order, pieces)
    return head, tail, np.cumsum(steps, axis=0), 0.2 + 0.5 * durations


@double
@pytest.mark.parametrize(("order", "pieces"), [(2, 5), (3, 1), (4, 8), (4, 128)])
def test_coefficients_and_gradients_are_those_of_a_dense_system(order, pieces):
    problem = draw(order, pieces)
    ((value, coeffs), slopes), ((known, expected), gradient) = (
        solved(spline)(*problem) for spline in (minco, dense_spline)
    )
    sizes = np.abs(expected).max(axis=(0, 2), keepdims=True)
    np.testing.assert_allclose(coeffs / sizes, expected / sizes, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(value, known, rtol=1e-9)
    for slope, exact in zip(slopes, gradient, strict=True):
        np.testing.assert_allclose(slope, exact, atol=1e-8 * np.abs(exact).max(initial=0.0))


@double
@pytest.mark.parametrize(("order", "pieces"), [(2, 4), (3, 3), (4, 6)])
def test_the_spline_is_the_dense_programs_and_that_of_fixed_proportions(order, pieces):
    problem = draw(order, pieces)
    path = jax.jit(minco)(*problem)
    for expected, bar in ((dense_solution(*problem), 1e-9), (interpolate(*problem).coeffs, 1e-12)):
        np.testing.assert_allclose(path.coeffs, expected, atol=bar * np.abs(expected).max())


@double
def test_second_derivatives_are_those_of_a_dense_system():
    problem = draw(2, 3)
    own, dense = (
        jax.jit(jax.hessian(energy_of(spline), (2, 3)))(*problem)
        for spline in (minco, dense_spline)
    )
    chex.assert_trees_all_close(own, dense, rtol=1e-8, atol=1e-8 * np.abs(dense[1][1]).max())


@double
def test_forward_derivatives_agree_with_the_gradient():
    problem = draw(4, 4)
    (value, _), (by_waypoints, by_durations) = solved(minco)(*problem)
    move = (*np.zeros((2, 4, 3)), *problem[2:])
    along = jax.jit(lambda *args: jax.jvp(energy_of(minco), *args))(problem, move)
    slope = np.sum(by_waypoints * problem[2]) + np.sum(by_durations * problem[3])
    np.testing.assert_allclose(along, (value, slope), rtol=1e-10)


@double
@pytest.mark.parametrize("order", [2, 4])
def test_the_spline_of_the_reversed_problem_is_the_reversed_spline(order):
    head, tail, waypoints, durations = draw(order, 4)
    signs = (-1.0) ** np.arange(order)[:, None]
    ahead = jax.jit(minco)(head, tail, waypoints, durations)
    back = jax.jit(minco)(tail * signs, head * signs, waypoints[::-1], durations[::-1])
    times = np.linspace(0.0, durations.sum(), 9)
    at = jax.jit(jax.vmap(evaluate, (None, 0)))
    np.testing.assert_allclose(at(back, durations.sum() - times), at(ahead, times), atol=1e-8)


@double
def test_newtons_method_finds_equal_durations_of_a_symmetric_problem():
    head, tail = np.zeros((2, 4, 1))
    tail[0] = 2.0

    def cost(tau):
        durations = durations_of(tau)
        return energy_of(minco)(head, tail, np.ones((1, 1)), durations) + 1e3 * jnp.sum(durations)

    @jax.jit
    def step(tau):
        slope = jax.grad(cost)(tau)
        return tau - jnp.linalg.solve(jax.hessian(cost)(tau), slope), slope

    tau = np.log([1.2, 1.5])
    for _ in range(12):
        tau, _ = step(tau)
    np.testing.assert_allclose(step(tau)[1], 0.0, atol=1e-7)
    np.testing.assert_allclose(tau[0], tau[1], atol=1e-9)


def test_a_batch_in_float32_equals_a_loop_and_double_precision():
    problems = [jax.tree.map(lambda x, k=k: x + 0.1 * k, draw(4, 8)) for k in range(3)]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves).astype(np.float32), *problems)
    paths = jax.jit(jax.vmap(minco))(*batch)
    assert paths.coeffs.dtype == np.float32
    times = np.linspace(0.0, 1.0, 9)[None] * problems[0][3][:, None]
    powers = times[..., None] ** np.arange(8)
    with jax.enable_x64(True):
        exact = [jax.jit(minco)(*(x[k].astype(np.float64) for x in batch)) for k in range(3)]
    for k, path in enumerate(exact):
        single = jax.jit(minco)(*(x[k] for x in batch))
        for coeffs in (paths.coeffs[k], single.coeffs):
            far = powers @ np.asarray(coeffs, np.float64) - powers @ np.asarray(path.coeffs)
            np.testing.assert_allclose(far, 0.0, atol=1e-3)


def test_value_and_gradient_need_memory_in_proportion_to_the_pieces():
    def sizes(pieces):
        every = equations(jax.make_jaxpr(solved(minco))(*draw(4, pieces)))
        return [each.aval.size for equation in every for each in equation.outvars]

    few, many = sizes(64), sizes(256)
    assert len(few) == len(many) > 100
    assert max(many) <= 4 * max(few) < (64 * 4) ** 2
    assert assert_full_precision(solved(minco), *draw(4, 3)) > 10


@double
def test_durations_of_unbounded_variables_are_positive_and_smooth():
    tau = jnp.array([-40.0, -1.0, 0.0, 1.0, 2.0])
    np.testing.assert_allclose(durations_of(tau), np.exp(tau))
    rational = lambda tau: durations_of(tau, "rational")  # noqa: E731
    np.testing.assert_allclose(rational(tau), [1.0 / 841.0, 0.4, 1.0, 2.5, 5.0])
    for nth in (rational, jax.grad(rational), jax.grad(jax.grad(rational))):
        np.testing.assert_allclose([nth(-1e-9), nth(1e-9)], 1.0, atol=1e-8)
    assert np.isfinite(jax.vmap(jax.grad(rational))(np.array([-1e30, 1e30]))).all()
