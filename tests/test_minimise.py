"""`minimise`: closed forms, active bounds, batches, derivatives, optax, errors."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.optimize

from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.optimise import LbfgsConfig, LevenbergConfig, NewtonConfig, OptaxSolver, minimise

LANES, SIZE = 5, 3
LBFGS = LbfgsConfig(max_steps=300, tolerance=0.0, patience=6)
NEWTON = NewtonConfig(max_steps=60, subspace=SIZE, tolerance=1e-12, patience=6)
LEAST = LevenbergConfig(max_steps=60, settled=6, tolerance=0.0, longest=100.0)
SOLVERS = pytest.mark.parametrize(
    "solver", [LBFGS, NEWTON, LEAST], ids=["lbfgs", "newton", "least"]
)

RNG = np.random.default_rng(3)
ROOTS = RNG.normal(size=(LANES, SIZE + 1, SIZE))
RIGHT = RNG.normal(size=(LANES, SIZE + 1))
STARTS = RNG.normal(size=(LANES, SIZE))
LOWER = np.tile([-0.2, -np.inf, 0.0], (LANES, 1))
UPPER = np.tile([0.3, 0.1, np.inf], (LANES, 1))


def residuals(x, root, right):
    return jnp.matmul(root, x, precision="highest") - right


def squares(x, root, right):
    return jnp.sum(residuals(x, root, right) ** 2)


def goal_of(solver):
    return residuals if isinstance(solver, LevenbergConfig) else squares


def rosenbrock(x):
    return (1.0 - x[0]) ** 2 + 100.0 * (x[1] - x[0] ** 2) ** 2


@functools.cache
def bounded(solver):
    with jax.enable_x64(True):
        data = {"args": (ROOTS, RIGHT), "bounds": (LOWER, UPPER)}
        return jax.tree.map(np.asarray, minimise(goal_of(solver), STARTS, solver, **data))


@SOLVERS
def test_a_linear_problem_has_its_closed_form(float64, solver):
    found = minimise(goal_of(solver), STARTS, solver, args=(ROOTS, RIGHT))
    expected = [np.linalg.lstsq(*pair, rcond=None)[0] for pair in zip(ROOTS, RIGHT, strict=True)]
    np.testing.assert_allclose(found.point, expected, atol=1e-4)
    np.testing.assert_allclose(found.cost, jax.vmap(squares)(found.point, ROOTS, RIGHT))
    assert found.is_stationary.all() and (found.gradient_norm <= 1e-5).all()


@SOLVERS
def test_bounds_hold_exactly_and_give_the_minimum_of_scipy(solver):
    found = bounded(solver)
    expected = [
        scipy.optimize.lsq_linear(root, right, (lower, upper), tol=1e-14).x
        for root, right, lower, upper in zip(ROOTS, RIGHT, LOWER, UPPER, strict=True)
    ]
    np.testing.assert_allclose(found.point, expected, atol=1e-4)
    at_bound = (found.point == LOWER) | (found.point == UPPER)
    assert 3 < at_bound.sum() < at_bound.size and (found.gradient_norm <= 1e-5).all()
    assert (found.point >= LOWER).all() and (found.point <= UPPER).all()


@SOLVERS
def test_a_lane_equals_a_batch_and_a_vmap_inside_jit(float64, solver):
    one = jax.jit(
        lambda x, root, right, *bounds: minimise(
            goal_of(solver), x, solver, args=(root, right), bounds=bounds
        )
    )
    batch = bounded(solver)
    mapped = jax.vmap(one)(STARTS, ROOTS, RIGHT, LOWER, UPPER)
    np.testing.assert_allclose(mapped.point, batch.point, atol=1e-9)
    alone = one(STARTS[1], ROOTS[1], RIGHT[1], LOWER[1], UPPER[1])
    assert alone.point.shape == (SIZE,) and alone.cost.shape == ()
    np.testing.assert_allclose(alone.point, batch.point[1], atol=1e-9)


def test_a_batch_may_be_empty():
    found = minimise(rosenbrock, np.zeros((0, 2), np.float32))
    assert found.point.shape == (0, 2) and found.cost.shape == (0,)


@pytest.mark.parametrize("upper", [4.0, 0.5])
@pytest.mark.parametrize("double", [False, True])
def test_the_default_solver_follows_a_curved_valley(upper, double):
    with jax.enable_x64(double):
        start = np.array([[-1.2, 1.0], [0.3, -1.0]], np.float64 if double else np.float32)
        bounds = (np.full(2, -np.inf), np.array([upper, np.inf]))
        found = minimise(rosenbrock, start, bounds=bounds)
        assert found.point.dtype == start.dtype
    x = min(upper, 1.0)
    np.testing.assert_allclose(found.point, [[x, x**2]] * 2, atol=2e-3)
    np.testing.assert_allclose(found.cost, (1.0 - x) ** 2, atol=1e-6)


def test_a_feasible_point_is_selected_before_a_cheaper_one():
    cost = lambda x: (jnp.sum(x**2) + 1e3 * jnp.sum(jnp.maximum(1.0 - x, 0.0) ** 2), 1.0 - x[0])  # noqa: E731
    found = minimise(cost, np.array([3.0], np.float32))
    assert found.violation <= 0.0 and 1.0 <= found.point[0] < 3.0


@pytest.mark.parametrize("transformation", [optax.adam(0.05), optax.lbfgs()], ids=["adam", "lbfgs"])
def test_transformations_of_optax_solve_with_and_without_bounds(transformation):
    solver, start = OptaxSolver(transformation, 800), np.array([[1.5, -1.0]], np.float32)
    cost = lambda x: (x[0] - 1.0) ** 2 + 2.0 * (x[1] - 1.0) ** 2  # noqa: E731
    bounds = (np.full((1, 2), -2.0), np.array([[0.5, 2.0]]))
    with jax.numpy_dtype_promotion("standard"):  # which optax needs
        free, within = (
            minimise(cost, start, solver, bounds=each, gradient_tolerance=1e-4)
            for each in (None, bounds)
        )
    np.testing.assert_allclose(free.point, 1.0, atol=1e-3)
    np.testing.assert_allclose(within.point, [[0.5, 1.0]], atol=1e-3)
    assert free.is_stationary.all() and within.is_stationary.all()
    assert 0 < free.iterations[0] < 800


@pytest.mark.parametrize("transform", [jax.jacfwd, jax.jacrev])
def test_derivatives_are_those_of_the_minimum(float64, transform):
    upper = np.array([0.3, 9.0])
    cost = lambda x, b: x[0] ** 2 + x[0] * x[1] + x[1] ** 2 - b @ x  # noqa: E731

    def point(b, shift, upper):  # the objective closes over `shift`
        bounds = (np.full(2, -9.0), upper)
        return minimise(
            lambda x, b: cost(x - shift, b), np.zeros(2), args=(b,), bounds=bounds
        ).point

    slope = jax.jit(transform(point, argnums=(0, 1, 2)))
    found = slope(np.array([2.0, 1.0]), np.zeros(2), upper)
    # The first variable is at its bound u, and the second is s_1 + (b_1 - u + s_0) / 2.
    by_b, by_shift, by_upper = found
    np.testing.assert_allclose(by_b, [[0.0, 0.0], [0.0, 0.5]], atol=1e-9)
    np.testing.assert_allclose(by_shift, [[0.0, 0.0], [0.5, 1.0]], atol=1e-9)
    np.testing.assert_allclose(by_upper, [[1.0, 0.0], [-0.5, 0.0]], atol=1e-9)


def test_the_derivative_of_an_unfinished_search_is_nan_and_its_status_says_so():
    cost = lambda b: lambda x: jnp.sum((x - b) ** 4)  # noqa: E731
    run = lambda b: minimise(cost(b), np.array([9.0], np.float32), LbfgsConfig(max_steps=1))  # noqa: E731
    found, slope = jax.jit(lambda b: jax.jvp(run, (b,), (jnp.ones_like(b),)))(np.float32(1.0))
    assert not found.is_stationary and found.iterations == 1
    assert jnp.isnan(slope.point).all()


def test_traced_bounds_in_the_wrong_order_give_nan():
    run = jax.jit(lambda *bounds: minimise(rosenbrock, jnp.zeros(2), bounds=bounds))
    found = run(jnp.ones(2), jnp.zeros(2))
    assert jnp.isnan(found.point).all() and not found.is_stationary


PLANE = np.zeros((2, 2), np.float32)
BAD = [
    ({"start": np.zeros(2, int)}, ArgumentTypeError, "start must be floating-point numbers"),
    ({"start": "x"}, ArgumentTypeError, "start must be numbers"),
    ({"start": np.float32(1.0)}, ArgumentError, r"start must have the shape \(n,\) or \(B, n\)"),
    ({"solver": "newton"}, ArgumentTypeError, "solver must be a LbfgsConfig or a NewtonConfig"),
    ({"objective": 1.0}, ArgumentTypeError, "objective must be a function"),
    ({"objective": lambda x: x}, ArgumentError, r"objective must return a cost \(\).*\(2,\)"),
    ({"solver": LEAST}, ArgumentError, r"objective must return residuals \(m,\)"),
    ({"args": np.zeros(2)}, ArgumentTypeError, "args must be a tuple"),
    ({"args": (np.zeros(3),)}, ArgumentError, r"args must have the leading axis 2, got \(3,\)"),
    ({"bounds": 1.0}, ArgumentTypeError, r"bounds must be a pair \(lower, upper\)"),
    ({"bounds": (np.zeros(3), np.ones(2))}, ArgumentError, r"bounds\[0\] must have the shape"),
    (
        {"bounds": (np.array([0.0, 2.0]), np.ones(2))},
        ArgumentError,
        r"bounds\[0\] must be <= bounds\[1\], got 2 at index \(0, 1\)",
    ),
    ({"gradient_tolerance": -1.0}, ArgumentError, "gradient_tolerance must be finite and >= 0"),
]


@pytest.mark.parametrize(("change", "error", "text"), BAD)
def test_bad_input_gets_one_clear_line(monkeypatch, change, error, text):
    monkeypatch.setattr("typecheck.is_on", False)
    arguments = {"objective": rosenbrock, "start": PLANE, **change}
    with pytest.raises(error, match=text) as raised:
        minimise(arguments.pop("objective"), arguments.pop("start"), **arguments)
    assert "\n" not in str(raised.value)


def test_an_optax_solver_rejects_what_is_no_transformation():
    with pytest.raises(ArgumentTypeError, match="transformation must be a GradientTransformation"):
        OptaxSolver("adam")
    with pytest.raises(ArgumentError, match="max_steps must be >= 0"):
        OptaxSolver(optax.adam(0.1), -1)
