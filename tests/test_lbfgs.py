"""L-BFGS: search directions of a textbook, known minima, and statuses at the end of a search."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.core.protocol import Status, status_of
from planner_jax.optimise import lbfgs
from planner_jax.optimise.lbfgs_kernel import turn_kernel
from planner_jax.optimise.multistart import minimise
from planner_jax.optimise.settings import Evaluation, LbfgsConfig

step = jax.jit(lbfgs.step, static_argnums=(0, 2))
direction_of = jax.jit(lbfgs.search_direction, static_argnums=2)
search = jax.jit(minimise, static_argnums=(0, 2))
remember_all = jax.jit(jax.vmap(lbfgs.remember, in_axes=-1, out_axes=-1))


@functools.cache
def without_limits(cost):
    return lambda x: Evaluation(cost=cost(x), violation=jnp.full((), -1.0, x.dtype))


def rosenbrock(x):
    return jnp.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2)


def stretch(x):
    return 0.5 * jnp.sum(jnp.logspace(0, 3, x.shape[0]) * (x - 1.0) ** 2)


LONG = LbfgsConfig(max_steps=300, tolerance=1e-12, patience=8)


@pytest.mark.parametrize("cost", [rosenbrock, stretch])
def test_known_minimum_is_found(float64, cost):
    found = search(without_limits(cost), np.full(6, -0.5), LONG)
    np.testing.assert_allclose(found.point, 1.0, atol=1e-4)
    assert found.stationary and found.evaluation.cost < 1e-8


def two_loop_by_the_book(steps, changes, grad):
    """Return the direction of [Nocedal2006, algorithm 7.4]; the oldest step is the first."""
    q, alphas = grad.copy(), []
    for s, y in zip(reversed(steps), reversed(changes), strict=True):
        alphas.append(s @ q / (y @ s))
        q -= alphas[-1] * y
    r = (steps[-1] @ changes[-1]) / (changes[-1] @ changes[-1]) * q
    for s, y, a in zip(steps, changes, reversed(alphas), strict=True):
        r += s * (a - y @ r / (y @ s))
    return -r


def test_direction_equals_the_two_loop_recursion(float64):
    config = LbfgsConfig(memory=4, step_cap=1e9)
    objective = without_limits(stretch)
    state = lbfgs.init(np.linspace(-1.0, 2.0, 5), config)
    points = [state.point]
    for _ in range(8):
        state = step(objective, state, config)
        points.append(state.point)
    points = np.asarray(points)
    grads = np.asarray(jax.jit(jax.vmap(jax.grad(stretch)))(points))
    steps, changes = np.diff(points[:-1], axis=0)[-4:], np.diff(grads[:-1], axis=0)[-4:]
    expected = two_loop_by_the_book(list(steps), list(changes), grads[-2])
    found = direction_of(state.memory, state.grad, config.step_cap)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    taken = points[-1] - points[-2]
    lengths = taken / expected
    np.testing.assert_allclose(lengths, lengths[0], rtol=1e-6)
    assert min(abs(lengths[0] - length) for length in config.trial_steps) < 1e-6


def test_first_direction_has_unit_length_whatever_the_gradient():
    memory = lbfgs.init(jnp.ones(4), LbfgsConfig()).memory
    for size in (1e-6, 1e6):
        direction = direction_of(memory, np.full(4, size, np.float32), 2.0)
        assert np.linalg.norm(direction) == pytest.approx(1.0)


def test_the_cost_never_rises_and_no_step_is_longer_than_the_cap():
    config, objective = LbfgsConfig(step_cap=0.1), without_limits(rosenbrock)
    state = lbfgs.init(jnp.full(4, -1.0), config)
    for _ in range(20):
        after = step(objective, state, config)
        length = np.linalg.norm(np.asarray(after.point) - np.asarray(state.point))
        assert length <= 0.1 * max(config.trial_steps) * 1.001
        assert rosenbrock(after.point) <= rosenbrock(state.point)
        state = after


def test_an_iteration_without_descent_empties_the_memory_and_shortens_steps():
    config = LbfgsConfig(trial_steps=(1.0,))
    state = lbfgs.init(jnp.full(3, 1e-3), config)  # a unit step overshoots
    state = step(without_limits(lambda x: jnp.sum(x**2)), state, config)
    np.testing.assert_array_equal(state.step, 0.0)
    assert state.numbers.reach < 1.0
    full = lbfgs.Memory(jnp.ones((6, 3)), jnp.ones((6, 3)), jnp.ones(6))
    memory = lbfgs.remember(full, state.step, jnp.zeros(3))
    np.testing.assert_array_equal(memory.inverse_curvature, 0.0)


def turn_in_kernel(*args):
    kernel = turn_kernel(3, 2.0, interpret=True)
    return kernel(jax.tree.structure(args), [jnp.asarray(x) for x in jax.tree.leaves(args)])


def test_the_kernel_computes_the_same_memory_and_direction():
    pairs, n, lanes = 3, 5, 32
    random = np.random.default_rng(3)
    curvature = np.logspace(0, 2, n)[:, None]
    steps = random.standard_normal((pairs, n, lanes)).astype(np.float32)
    changes = (curvature * steps).astype(np.float32)
    inverse = 1.0 / (steps * changes).sum(axis=1)
    inverse[0, :8] = 0.0  # not all slots are filled
    step = random.standard_normal((n, lanes)).astype(np.float32)
    change = (curvature * step).astype(np.float32)
    change[:, 8:16] *= -1.0  # curvature that is not positive
    step[:, 16:24] = 0.0
    grad = random.standard_normal((n, lanes)).astype(np.float32)
    memory = lbfgs.Memory(steps, changes, inverse.astype(np.float32))
    args = memory, step, change, grad

    expected = jax.jit(jax.vmap(lbfgs._turn(pairs, 2.0), in_axes=-1, out_axes=-1))(*args)
    found = turn_in_kernel(*args)
    for ours, theirs in zip(found, jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("size", "kept"), [(0.0, 0), (1e-30, 0), (np.nan, 0), (1e-15, 3)])
def test_the_memory_is_kept_while_the_squared_length_of_a_step_is_above_zero(size, kept):
    full = lambda value, *shape: jnp.asarray(np.full((*shape, 32), value, np.float32))  # noqa: E731
    memory = lbfgs.Memory(full(1.0, 3, 5), full(1.0, 3, 5), full(0.2, 3))
    args = memory, full(size, 5), full(-1.0, 5), full(1.0, 5)
    plain = remember_all(*args[:3])
    *memory, _ = turn_in_kernel(*args)
    np.testing.assert_array_equal((np.asarray(plain.inverse_curvature) != 0.0).sum(axis=0), kept)
    for ours, theirs in zip(memory, jax.tree.leaves(plain), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_best_feasible_iterate_is_kept_when_the_minimum_is_infeasible():
    def objective(x):
        return Evaluation(cost=jnp.sum(x**2), violation=1.0 - jnp.min(x))

    config = LbfgsConfig(max_steps=80, trial_steps=(0.3,), step_cap=0.2)
    found = search(objective, np.full(2, 3.0, np.float32), config)
    assert found.evaluation.violation <= 0.0
    assert jnp.all((found.point >= 1.0) & (found.point < 1.5))


def end_of(objective, start, **options):
    found = search(objective, start, LbfgsConfig(**options))
    numbers = found.evaluation.cost, found.evaluation.violation, found.stationary
    return Status(int(status_of(*numbers)))


def test_every_end_of_a_search_has_its_status():
    start = np.full(4, -0.5, np.float32)
    infeasible = lambda x: Evaluation(stretch(x), jnp.full((), 0.2, x.dtype))  # noqa: E731
    assert end_of(without_limits(stretch), start, max_steps=200) is Status.CONVERGED
    assert end_of(without_limits(rosenbrock), start, max_steps=2) is Status.FEASIBLE
    assert end_of(infeasible, start, max_steps=200) is Status.INFEASIBLE
    assert end_of(infeasible, start, max_steps=1) is Status.MAX_STEPS
    nan = lambda x: jnp.sum(x) * jnp.nan  # noqa: E731
    assert end_of(without_limits(nan), start, max_steps=5) is Status.NON_FINITE
    assert len({status.message for status in Status}) == len(Status)


def test_a_flat_objective_is_stationary_and_steps_to_undefined_costs_are_rejected():
    found = search(without_limits(lambda x: 0.0 * jnp.sum(x) + 1.0), jnp.ones(3), LbfgsConfig())
    assert found.stationary and jnp.all(jnp.isfinite(found.point))
    found = search(without_limits(lambda x: jnp.sum(x - jnp.log(x))), jnp.full(3, 0.2), LONG)
    np.testing.assert_allclose(found.point, 1.0, atol=1e-2)


def test_batch_equals_loop_with_unequal_lanes_and_a_broken_one(float64):
    def solve(start, scale):
        return minimise(without_limits(lambda x: scale * rosenbrock(x)), start, LbfgsConfig(30))

    starts = np.array([[-0.5, 0.3], [2.0, -1.0], [1.0, 1.0], [0.1, 0.0]], np.float64)
    scales = np.array([1.0, 1e-4, 30.0, np.nan], np.float64)
    one, many = jax.jit(solve), jax.jit(jax.vmap(solve))
    batch = many(starts, scales)
    healthy = many(starts, np.array([*scales[:3], 1.0], np.float64))
    for lane in range(3):
        alone = one(starts[lane], scales[lane])
        np.testing.assert_allclose(batch.point[lane], alone.point, rtol=1e-6)
        np.testing.assert_array_equal(batch.point[lane], healthy.point[lane])
    assert not jnp.isfinite(batch.evaluation.cost[3])


@pytest.mark.parametrize(("name", "value"), [("max_steps", -1), ("memory", 0)])
def test_invalid_sizes_raise(name, value):
    with pytest.raises(ValueError, match=f"{name} must be >= "):
        LbfgsConfig(**{name: value})
