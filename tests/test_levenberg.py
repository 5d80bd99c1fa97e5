"""Least squares by Levenberg-Marquardt."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.optimise.levenberg import LevenbergConfig, Model, least_squares


def of_residuals(residuals, violation=lambda x: jnp.array(-1.0)):
    def evaluate(x):
        r, slopes = residuals(x), jax.jacfwd(residuals)(x)
        gradient, curvature = (jnp.matmul(a, slopes, precision="highest") for a in (r, slopes.T))
        return Model(jnp.sum(r**2), gradient, curvature, violation(x))

    return evaluate


def rosenbrock(x):
    return jnp.stack([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


LONG = LevenbergConfig(max_steps=60, tolerance=0.0, settled=61)
solve = jax.jit(
    lambda x, config: least_squares(of_residuals(rosenbrock), x, config), static_argnums=1
)


START = np.array([-1.2, 1.0])


def test_a_linear_problem_and_a_curved_valley_are_solved(float64):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(12, 5)), rng.normal(size=12)
    residuals = lambda x: jnp.matmul(a, x, precision="highest") - b  # noqa: E731
    config = dataclasses.replace(LONG, longest=100.0)
    found = least_squares(of_residuals(residuals), jnp.zeros(5), config)
    np.testing.assert_allclose(found.point, np.linalg.lstsq(a, b, rcond=None)[0], atol=1e-8)
    np.testing.assert_allclose(solve(START, LONG).point, 1.0, rtol=1e-8)


def test_the_cost_never_rises_and_no_step_is_longer_than_the_cap(float64):
    before, cost = START, np.inf
    for steps in range(6):
        found = solve(START, dataclasses.replace(LONG, max_steps=steps, longest=0.3))
        assert found.model.cost <= cost
        assert np.abs(found.point - before).max() <= 0.3 + 1e-12
        before, cost = found.point, found.model.cost
        assert found.steps == steps


def test_only_a_feasible_point_that_settles_ends_the_search(float64):
    config = dataclasses.replace(LONG, tolerance=1e-2, settled=2)
    assert solve(jnp.array([1.0, 1.0]), config).steps == 2
    bad = of_residuals(rosenbrock, lambda x: jnp.array(1.0))
    assert least_squares(bad, jnp.array([1.0, 1.0]), config).steps == config.max_steps


def test_a_batch_equals_its_lanes_and_a_broken_one_affects_no_other():
    starts = jnp.array([[-1.2, 1.0], [np.nan, 0.0], [2.0, 2.0]])
    batch = jax.jit(jax.vmap(lambda x: least_squares(of_residuals(rosenbrock), x, LONG)))(starts)
    for k in (0, 2):
        np.testing.assert_allclose(batch.point[k], solve(starts[k], LONG).point, atol=2e-3)
    assert not np.isfinite(batch.model.cost[1])


def test_a_costly_search_is_aborted_after_its_trial(float64):
    hopes = ({"trial": 3, "hope": 0.0}, {"trial": 3, "hope": 1e9}, {})
    ends = [solve(START, dataclasses.replace(LONG, **options)) for options in hopes]
    assert [int(end.steps) for end in ends] == [3, 60, 60]
