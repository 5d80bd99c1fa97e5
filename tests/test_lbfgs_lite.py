"""L-BFGS with the rules of LBFGS-Lite, and the planners of hits and catches that use it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize, rosen

import planner_jax as pj
from planner_jax.baselines.hit.bat import BatHit
from planner_jax.baselines.parts.lbfgs_lite import LitePlanner, LiteRule, minimise_lite

UNIT = 1e4  # divisor of the cost of `BatHit`
TIGHT = LiteRule(gradient=1e-9, decrease=1e-14, max_steps=20000)
float64 = pytest.mark.usefixtures("float64")


@functools.partial(jax.jit, static_argnums=(0, 2))
def search(cost, start, rule=LiteRule()):  # noqa: B008
    return minimise_lite(cost, start, rule)


def valley(x):
    return jnp.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2)


def bowl(x):
    return 1.0 + jnp.sum(jnp.asarray([1.0, 10.0, 100.0], x.dtype) * (x - 3.0) ** 2)


def barrier(x):
    return jnp.sum(x - jnp.log(x))  # not a number below 0


@float64
def test_minima_of_a_curved_valley_and_of_a_cost_with_undefined_points_are_found():
    start = np.array([-1.2, 1.0, -0.7, 0.4])
    assert valley(start) == pytest.approx(rosen(start))
    point, cost, iterations, stationary = search(valley, start, TIGHT)
    np.testing.assert_allclose(point, 1.0, atol=1e-6)
    assert stationary and cost < 1e-12 and 10 < iterations < 200
    point, _, _, stationary = search(barrier, np.array([0.01, 30.0]), TIGHT)
    assert stationary
    np.testing.assert_allclose(point, 1.0, atol=1e-7)


def test_in_single_precision_a_batch_is_a_loop_over_its_cases():
    starts = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    batch = jax.vmap(lambda start: search(bowl, start))(starts)
    assert batch[0].dtype == np.float32 and batch[3].all()
    np.testing.assert_allclose(batch[1], 1.0, rtol=1e-5)
    for k, start in enumerate(starts):
        for one, many in zip(search(bowl, start), batch, strict=True):
            np.testing.assert_allclose(one, many[k], rtol=1e-4)


def test_the_search_stops_by_its_gradient_its_decrease_or_its_iterations():
    start = np.full(3, -2.0, np.float32)
    assert search(bowl, np.full(3, 3.0, np.float32))[2:] == (0, True)
    assert search(bowl, start, LiteRule(decrease=1e9))[2:] == (3, True)
    assert search(bowl, start, LiteRule(max_steps=2))[2:] == (2, False)


def test_a_search_without_an_acceptable_step_ends_where_it_is():
    start = np.full(2, 5.0, np.float32)
    point, cost, iterations, stationary = search(lambda x: -jnp.sum(x), start)
    np.testing.assert_array_equal(point, start)
    assert cost == -10.0 and iterations == 0 and not stationary
    point, cost, iterations, stationary = search(barrier, -start)
    assert np.isposinf(cost) and iterations == 0 and not stationary


@functools.partial(jax.jit, static_argnums=0)
def value_and_slope(problem, x, context):
    return jax.value_and_grad(lambda x: UNIT * problem.objective(x, context)[0])(x)


def end_by_scipy(problem, guess, context):
    """Return the cost at which SciPy's L-BFGS-B ends from a first guess of a problem."""

    def finite(x):
        value, slope = (np.asarray(each, float) for each in value_and_slope(problem, x, context))
        is_finite = np.isfinite(value) and np.isfinite(slope).all()
        return (float(value), slope) if is_finite else (1e15, np.zeros(x.shape))

    options = {"maxiter": 20000, "maxfun": 40000, "ftol": 1e-14, "gtol": 1e-9, "maxcor": 20}
    return minimize(finite, guess, jac=True, method="L-BFGS-B", options=options).fun / UNIT


@float64
@pytest.mark.slow
def test_hits_end_at_the_optimum_of_scipy():
    cases, problem = pj.hit.draw(100, seed=3, dtype=jnp.float64), BatHit()
    plans = pj.plan(LitePlanner(problem, UNIT, TIGHT), cases)
    contexts = jax.device_get(jax.jit(jax.vmap(problem.prepare))(cases))
    guesses = np.asarray(jax.jit(jax.vmap(problem.first_guess))(contexts))
    ends = [end_by_scipy(problem, guesses[k], pj.take(contexts, k)) for k in range(100)]
    gap = np.abs(plans.cost / np.array(ends) - 1.0)
    assert (gap <= 1e-5).mean() >= 0.95
