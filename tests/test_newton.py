"""Newton's method in a subspace: closed forms, limit cases, and a batch beside its lanes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.optimise.evaluation import Evaluation
from planner_jax.optimise.multistart import minimise, minimise_lanes
from planner_jax.optimise.newton import NewtonConfig, by_products, damped_steps

CURVED = np.array([[3.0, 1.0, 0.2], [1.0, 2.0, 0.0], [0.2, 0.0, 1.0]])
SLOPE = np.array([1.0, -2.0, 0.5])
WHOLE = NewtonConfig(subspace=3, step_cap=100.0)


def bowl(x):
    cost = 0.5 * x @ jnp.asarray(CURVED, x.dtype) @ x + jnp.asarray(SLOPE, x.dtype) @ x
    return Evaluation(cost, jnp.asarray(-1.0, x.dtype))


def rosenbrock(x, steepness=100.0):
    cost = 1.0 + jnp.sum(steepness * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2)
    return Evaluation(cost, jnp.asarray(-1.0, x.dtype))


def steps_of(matrix, slope, dampings, config=WHOLE):
    matrix = jnp.asarray(matrix, jnp.float32)
    return damped_steps(
        jnp.asarray(slope, jnp.float32), lambda p: matrix @ p, jnp.asarray(dampings), config
    )


def test_a_step_in_the_whole_space_is_newtons():
    steps, promised = steps_of(CURVED, SLOPE, [0.0, 0.7])
    for step, damping in zip(steps, (0.0, 0.7), strict=True):
        exact = -np.linalg.solve(CURVED + damping * np.eye(3), SLOPE)
        np.testing.assert_allclose(step, exact, rtol=2e-5, atol=2e-6)
    np.testing.assert_allclose(promised, 0.5 * SLOPE @ np.linalg.solve(CURVED, SLOPE), rtol=1e-5)


def test_where_the_cost_bends_downward_the_hessian_is_shifted_by_that_much():
    bent = CURVED - 4.0 * np.eye(3)
    steps, promised = steps_of(bent, SLOPE, [0.5])
    shift = -np.linalg.eigvalsh(bent)[0]
    exact = -np.linalg.solve(bent + (shift + 0.5) * np.eye(3), SLOPE)
    # The least eigenvalue is halved to some thousandths of the interval that must hold it.
    np.testing.assert_allclose(steps[0], exact, rtol=5e-3)
    assert promised > 0.0


def test_a_step_is_no_longer_than_the_cap():
    steps, _ = steps_of(CURVED, 100.0 * SLOPE, [0.0], NewtonConfig(subspace=3, step_cap=0.25))
    np.testing.assert_allclose(np.linalg.norm(steps), 0.25, rtol=1e-5)


@pytest.mark.parametrize("slope", [np.zeros(3), np.array([0.0, 0.0, 2.0])], ids=["none", "own"])
def test_a_subspace_that_ends_early_gives_finite_steps(slope):
    steps, promised = steps_of(np.diag([1.0, 2.0, 4.0]), slope, [0.0])
    np.testing.assert_allclose(steps[0], -slope / [1.0, 2.0, 4.0], atol=1e-6)
    assert np.isfinite(promised)


def test_a_bowl_takes_one_iteration():
    config = NewtonConfig(max_steps=1, subspace=3, damping=1e-7, step_cap=100.0)
    found = minimise(bowl, jnp.array([4.0, -3.0, 2.0]), config)
    np.testing.assert_allclose(found.point, -np.linalg.solve(CURVED, SLOPE), atol=1e-4)


def test_the_products_of_an_objective_are_its_hessians():
    x = jnp.array([0.3, -0.4, 1.1])
    evaluation, gradient, product = by_products(rosenbrock)(x)
    cost = lambda x: rosenbrock(x).cost  # noqa: E731
    np.testing.assert_allclose(evaluation.cost, cost(x))
    np.testing.assert_allclose(gradient, jax.grad(cost)(x), rtol=1e-6)
    for unit, row in zip(jnp.eye(3), jax.hessian(cost)(x), strict=True):
        np.testing.assert_allclose(product(unit), row, rtol=1e-5, atol=1e-4)


def test_a_curved_valley_is_followed_to_its_end():
    found = minimise(rosenbrock, jnp.array([-1.2, 1.0]), NewtonConfig(max_steps=60, subspace=2))
    np.testing.assert_allclose(found.point, 1.0, atol=2e-3)
    assert found.stationary


def test_a_batch_ends_where_its_lanes_do_and_stragglers_go_on():
    starts = jnp.array([[-1.2, 1.0], [0.9, 0.8], [1.5, -0.5], [1.0, 1.0]])
    config = NewtonConfig(max_steps=3, subspace=2)
    steepness = jnp.array([100.0, 10.0, 50.0, 1.0])
    lanes = jax.jit(lambda s, c: minimise_lanes(rosenbrock, s, c, config))(starts.T, steepness)
    for k in range(len(starts)):
        alone = minimise(lambda x, k=k: rosenbrock(x, steepness[k]), starts[k], config)
        np.testing.assert_allclose(lanes.point[:, k], alone.point, rtol=1e-4, atol=1e-5)
    longer = NewtonConfig(max_steps=3, subspace=2, stragglers=((0.5, 40),))
    late = jax.jit(lambda s, c: minimise_lanes(rosenbrock, s, c, longer))(starts.T, steepness)
    went_on = np.asarray(late.iterations) > np.asarray(lanes.iterations)
    assert 1 <= went_on.sum() <= 2
    assert went_on[np.argmax(lanes.evaluation.cost)]
    assert np.all(late.evaluation.cost <= lanes.evaluation.cost)
    np.testing.assert_allclose(late.evaluation.cost[went_on], 1.0, atol=1e-3)


@pytest.mark.parametrize(
    ("argument", "value", "error"),
    [
        ("max_steps", -1, ValueError),
        ("subspace", 0, ValueError),
        ("trial_dampings", (), ValueError),
        ("trial_dampings", 0.1, TypeError),
        ("damping", float("nan"), ValueError),
        ("stragglers", ((1.5, 4),), ValueError),
        ("stragglers", 0.5, TypeError),
    ],
)
def test_a_size_that_cannot_be_meant_is_refused(argument, value, error):
    with pytest.raises(error, match=argument):
        NewtonConfig(**{argument: value})
