"""Newton's method in a subspace: closed forms, limit cases, and batches against single cases."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.cost.penalty import smooth_hinge
from planner_jax.optimise.multistart import minimise
from planner_jax.optimise.newton import by_products, solve_damped
from planner_jax.optimise.newton_lanes import minimise_lanes
from planner_jax.optimise.settings import Curvature, Evaluation, NewtonConfig

CURVED = np.array([[3.0, 1.0, 0.2], [1.0, 2.0, 0.0], [0.2, 0.0, 1.0]])
SLOPE = np.array([1.0, -2.0, 0.5])
WHOLE = NewtonConfig(subspace=3, step_cap=100.0)
search = jax.jit(minimise, static_argnums=(0, 2, 3))


def bowl(x):
    cost = 0.5 * x @ jnp.asarray(CURVED, x.dtype) @ x + jnp.asarray(SLOPE, x.dtype) @ x
    return Evaluation(cost, jnp.asarray(-1.0, x.dtype))


def rosenbrock(x, steepness=100.0):
    cost = 1.0 + jnp.sum(steepness * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2)
    return Evaluation(cost, jnp.asarray(-1.0, x.dtype))


@functools.partial(jax.jit, static_argnames="config")
def steps_of(matrix, slope, damping, config=WHOLE, kept=None):
    matrix = jnp.asarray(matrix, jnp.float32)

    def preconditioner(damping):
        if kept is None:
            return lambda right: right / damping
        inverse = jnp.linalg.inv(jnp.asarray(kept, jnp.float32) + damping * jnp.eye(3))
        return lambda right: inverse @ right

    here = Curvature(
        Evaluation(jnp.zeros(()), jnp.zeros(())),
        jnp.asarray(slope, jnp.float32),
        lambda: lambda direction: matrix @ direction,
        preconditioner,
    )
    return solve_damped(here, jnp.asarray(damping, jnp.float32), config)


DIAGONAL = np.diag(np.diag(CURVED))


@pytest.mark.parametrize(
    ("subspace", "kept"), [(3, np.zeros((3, 3))), (3, DIAGONAL), (0, DIAGONAL)]
)
def test_a_step_in_the_whole_space_is_newtons_and_without_one_the_preconditioners(subspace, kept):
    damping, trials = 0.4, (0.0, 0.7)
    config = NewtonConfig(subspace=subspace, step_cap=100.0, trial_dampings=trials)
    steps, predicted = steps_of(CURVED, SLOPE, damping, config, kept)
    beside = kept + damping * np.eye(3)
    own = CURVED + damping * np.eye(3) if subspace else beside
    for step, trial in zip(steps, trials, strict=True):
        exact = -np.linalg.solve(own + trial * beside, SLOPE)
        np.testing.assert_allclose(step, exact, rtol=5e-5 if subspace else 1e-5, atol=5e-6)
    np.testing.assert_allclose(predicted, 0.5 * SLOPE @ np.linalg.solve(own, SLOPE), rtol=1e-5)


def test_an_indefinite_hessian_is_shifted_by_its_least_eigenvalue():
    bent, damping = CURVED - 4.0 * np.eye(3), 1e-3
    config = NewtonConfig(subspace=3, step_cap=100.0, trial_dampings=(500.0,))
    steps, predicted = steps_of(bent, SLOPE, damping, config)
    shift = -np.linalg.eigvalsh(bent)[0]
    exact = -np.linalg.solve(bent + (shift + 500.0 * damping) * np.eye(3), SLOPE)
    np.testing.assert_allclose(steps[0], exact, rtol=5e-3)
    assert predicted > 0.0


def test_a_positive_eigenvalue_of_a_millionth_of_the_greatest_causes_no_shift():
    steep, slope = np.diag([1.0, 0.3, 1e-6]), np.array([1.0, -1.0, 1e-4])
    config = NewtonConfig(subspace=3, step_cap=1e9, trial_dampings=(0.0,))
    steps, _ = steps_of(steep, slope, 1e-9, config, kept=np.diag([0.9, 0.3, 2e-6]))
    np.testing.assert_allclose(steps[0], [-1.0, 1.0 / 0.3, -1e2], rtol=5e-3)


def test_a_step_is_no_longer_than_the_cap():
    steps, _ = steps_of(CURVED, 100.0 * SLOPE, 1e-3, NewtonConfig(subspace=3, step_cap=0.25))
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.25, rtol=1e-5)


@pytest.mark.parametrize("slope", [np.zeros(3), np.array([0.0, 0.0, 2.0])], ids=["none", "own"])
def test_a_subspace_that_ends_early_gives_finite_steps(slope):
    steps, predicted = steps_of(np.diag([1.0, 2.0, 4.0]), slope, 1e-6)
    np.testing.assert_allclose(steps[0], -slope / [1.0, 2.0, 4.0], atol=1e-5)
    assert np.isfinite(predicted)


def test_a_bowl_takes_one_iteration():
    config = NewtonConfig(max_steps=1, subspace=3, damping=1e-7, step_cap=100.0)
    found = search(bowl, np.float32([4.0, -3.0, 2.0]), config)
    np.testing.assert_allclose(found.point, -np.linalg.solve(CURVED, SLOPE), atol=1e-4)


def test_the_products_of_an_objective_are_its_hessians():
    cost = lambda x: rosenbrock(x).cost  # noqa: E731

    @jax.jit
    def expand(x):
        evaluation, gradient, products, preconditioner = by_products(rosenbrock)(x)
        found = evaluation.cost, gradient, jax.vmap(products())(jnp.eye(3)), preconditioner(4.0)(x)
        return found, (cost(x), jax.grad(cost)(x), jax.hessian(cost)(x), x / 4.0)

    for found, expected in zip(*expand(np.float32([0.3, -0.4, 1.1])), strict=True):
        np.testing.assert_allclose(found, expected, rtol=2e-6, atol=1e-6)


def test_a_curved_valley_is_followed_to_its_end():
    found = search(rosenbrock, np.float32([-1.2, 1.0]), NewtonConfig(max_steps=60, subspace=2))
    np.testing.assert_allclose(found.point, 1.0, atol=2e-3)
    assert found.stationary


def test_a_batch_equals_its_lanes_and_stragglers_continue():
    starts = jnp.array([[-1.2, 1.0], [0.9, 0.8], [1.5, -0.5], [1.0, 1.0]])
    steepness = jnp.array([100.0, 10.0, 50.0, 1.0])

    def solve(stragglers=None):
        config = NewtonConfig(max_steps=3, subspace=2, stragglers=stragglers)
        return jax.jit(lambda s, c: minimise_lanes(rosenbrock, s, c, config))(starts.T, steepness)

    lanes, config = solve(), NewtonConfig(max_steps=3, subspace=2)
    alone = jax.jit(lambda start, c: minimise(lambda x: rosenbrock(x, c), start, config).point)
    for k in range(len(starts)):
        one = alone(starts[k], steepness[k])
        np.testing.assert_allclose(lanes.point[:, k], one, rtol=1e-4, atol=1e-5)
    late = solve((0.5, 40, 1))
    continued = np.asarray(late.iterations) > np.asarray(lanes.iterations)
    assert 1 <= continued.sum() <= 2
    assert continued[np.argmax(lanes.evaluation.cost)]
    assert np.all(late.evaluation.cost <= lanes.evaluation.cost)
    np.testing.assert_allclose(late.evaluation.cost[continued], 1.0, atol=1e-3)
    last = solve((0.25, 20, 50))
    np.testing.assert_allclose(last.evaluation.cost, 1.0, atol=1e-3)
    assert last.stationary.all() and (last.iterations <= 3 + 20 * 50).all()
    # The problem with index 3 starts at its optimum, so it gets no further iterations.
    assert last.iterations[3] == lanes.iterations[3]


def by_hessian(cost):
    def expand(x):
        by, hessian = jax.grad(cost)(x), jax.hessian(cost)(x)

        def preconditioner(damping):
            inverse = jnp.linalg.inv(hessian + damping * jnp.eye(x.size))
            return lambda right: inverse @ right

        return Curvature(of_cost(cost)(x), by, lambda: lambda d: hessian @ d, preconditioner)

    return expand


def of_cost(cost):
    return lambda x: Evaluation(cost(x), jnp.asarray(-1.0, x.dtype))


def test_the_search_does_not_end_just_before_a_limit():
    def cost(x):  # a steep penalty starts at x = 0.02, just before the optimum
        slope = 1e-6 * jnp.sum((x - 2.0) ** 2) + 1e-5
        return slope + 10.0 * jnp.sum(smooth_hinge(x - 0.02, 0.05))

    numbers = {"damping": 1e-9, "tolerance": 1e-3, "trusted": 1e-9, "patience": 6}
    config = NewtonConfig(max_steps=60, subspace=0, **numbers)
    start, curved, objective = jnp.zeros(1), by_hessian(cost), of_cost(cost)
    slope = jax.jit(jax.grad(cost))
    found = search(objective, start, config, curved)
    assert found.stationary
    assert found.point[0] > 0.02
    assert abs(slope(found.point)[0]) < 0.1 * abs(slope(start)[0])
    hasty = search(objective, start, dataclasses.replace(config, trusted=1e4), curved)
    assert hasty.stationary and hasty.point[0] < 0.02


def test_steps_continue_by_the_slope_where_costs_are_equal():
    """All costs round to 1 in float32, so only the slopes show where the minimum is."""

    def cost(x):
        return 1.0 + 1e-9 * jnp.sum((x - 3.0) ** 2)

    def solve(config):
        return search(of_cost(cost), jnp.zeros(2), config, by_hessian(cost))

    config = NewtonConfig(max_steps=8, subspace=0, damping=1e-13, tolerance=1e-12, step_cap=9.0)
    np.testing.assert_array_equal(solve(config).point, 0.0)
    found = solve(dataclasses.replace(config, slack=4.0))
    np.testing.assert_allclose(found.point, 3.0, rtol=1e-3)
    assert found.stationary


@pytest.mark.parametrize(
    ("argument", "value", "error"),
    [
        ("subspace", -1, ValueError),
        ("trial_dampings", (), ValueError),
        ("trial_dampings", 0.1, TypeError),
        ("damping", float("nan"), ValueError),
        ("trusted", float("nan"), ValueError),
        ("stragglers", (1.5, 4, 1), ValueError),
        ("stragglers", (0.5, 4, 0), ValueError),
        ("stragglers", 0.5, TypeError),
    ],
)
def test_invalid_settings_raise(argument, value, error):
    with pytest.raises(error, match=argument):
        NewtonConfig(**{argument: value})
