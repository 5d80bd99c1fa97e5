"""L-BFGS for small smooth problems, made for batches.

The functions solve ONE problem; `jax.vmap` makes a batch. A lane is one problem of the batch. A
finished lane keeps its point while other lanes continue. Each iteration tries several step lengths
at once, because under `vmap` a backtracking search would continue until the slowest lane is done.
The solver also tracks feasibility, and returns the best feasible iterate.

The direction is computed by the two-loop recursion of [Liu1989]. Its initial scale is
gamma = s.y / y.y, for the newest step s and the change y of the gradient along it.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.protocol import is_better
from planner_jax.lanes import with_kernel
from planner_jax.optimise.settings import Evaluation, LbfgsConfig, Objective


@struct.dataclass
class Memory:
    """The last m steps of a search in n variables, and the changes of the gradient along them."""

    steps: Array  # (m, n), s_k of [Liu1989], steps, newest last
    changes: Array  # (m, n), y_k, changes of the gradient, newest last
    inverse_curvature: Array  # (m,), 1 / s.y; 0 where no step is stored


@struct.dataclass
class LbfgsNumbers:
    """The scalars in the state of L-BFGS for one problem of the batch."""

    best: Evaluation  # objective at the best point; not finite before the first iteration
    reach: Array  # (), factor on the trial steps; it shrinks while no trial lowers the cost
    iteration: Array  # () int32
    stalled: Array  # () int32, iterations in a row that hardly lowered the cost


@struct.dataclass
class LbfgsState:
    """The state of L-BFGS for one problem of the batch, between two iterations."""

    point: Array  # (n,)
    step: Array  # (n,), last step, which led to the point; 0 if there was none
    grad: Array  # (n,), gradient at the start of the last step
    memory: Memory
    best_point: Array  # (n,)
    numbers: LbfgsNumbers


def init(point: Array, config: LbfgsConfig) -> LbfgsState:
    """Return the state before the first iteration from a `point` (n,); nothing is evaluated."""
    zero = jnp.zeros_like(point)
    empty = jnp.zeros((config.memory, point.shape[0]), point.dtype)
    unknown = jnp.full((), jnp.inf, point.dtype)
    return LbfgsState(
        point=point,
        step=zero,
        grad=zero,
        memory=Memory(steps=empty, changes=empty, inverse_curvature=empty[:, 0]),
        best_point=point,
        numbers=LbfgsNumbers(
            best=Evaluation(unknown, unknown),
            reach=jnp.ones((), point.dtype),
            iteration=jnp.zeros((), jnp.int32),
            stalled=jnp.zeros((), jnp.int32),
        ),
    )


def weigh_pair(curvature: Array, change: Array, step: Array) -> tuple[Array, Array, Array]:
    """Decide whether a new pair (step s, change of gradient y) is stored, given s.y, y.y and s.s.

    Returns whether the pair is stored, because the curvature s.y is positive; whether the step is
    longer than zero; and 1 / s.y if the pair is stored, otherwise 0.
    """
    keep = curvature > 1e-8 * change
    return keep, step > 0.0, jnp.where(keep, 1.0 / jnp.where(keep, curvature, 1.0), 0.0)


def start_scale(newest: Array, change: Array, grad: Array) -> Array:
    """Return the initial scale of the two-loop recursion: s.y / y.y of the newest stored pair.

    `newest` is 1 / s.y, and `change` is y.y. Without a pair the scale is 1 / sqrt(`grad`), where
    `grad` is the squared norm of the gradient.
    """
    size = change * newest
    slope = jnp.sqrt(jnp.maximum(grad, 1e-30))
    return jnp.where(newest > 0.0, 1.0 / jnp.where(newest > 0.0, size, 1.0), 1.0 / slope)


def shortening(squared_length: Array, step_cap: float) -> Array:
    """Return the factor <= 1 that shortens a vector of this squared length to `step_cap`."""
    return jnp.minimum(1.0, step_cap / jnp.sqrt(jnp.maximum(squared_length, 1e-30)))


def remember(memory: Memory, step: Array, change: Array) -> Memory:
    """Return the memory with one more pair: a step (n,) and the change of the gradient (n,).

    A pair without positive curvature is not stored. A step of length zero empties the memory, so
    that the next direction is steepest descent.
    """
    keep, moved, inverse = weigh_pair(jnp.sum(step * change), jnp.sum(change**2), jnp.sum(step**2))

    def push(old: Array, new: Array) -> Array:
        return jnp.where(keep, jnp.concatenate([old[1:], new[None]]), jnp.where(moved, old, 0.0))

    return Memory(
        steps=push(memory.steps, step),
        changes=push(memory.changes, change),
        inverse_curvature=push(memory.inverse_curvature, inverse),
    )


def search_direction(memory: Memory, grad: Array, step_cap: float) -> Array:
    """Return the quasi-Newton direction -H g (n,) for the gradient g, not longer than `step_cap`.

    H approximates the inverse Hessian by the stored pairs of steps and gradient changes. Without a
    pair the direction is steepest descent with length 1, a moderate step in scaled variables.
    """
    return recur_twice(memory, grad, step_cap, _scan_unrolled, lambda function: function)


def recur_twice(
    memory: Memory, grad: Array, step_cap: float, scan: Callable, over: Callable
) -> Array:
    """Return the direction by loops of `scan`; `over` maps a function of one problem."""
    q, alphas = scan(over(_recur_back), grad, memory, reverse=True)
    q = over(_scale_start)(q, memory, grad)
    q, _ = scan(over(_recur_forth), q, (memory, alphas))
    return over(lambda q: -q * shortening(jnp.sum(q**2), step_cap))(q)


def _recur_back(q: Array, pair: Memory) -> tuple[Array, Array]:
    alpha = pair.inverse_curvature * jnp.sum(pair.steps * q)
    return q - alpha * pair.changes, alpha


def _scale_start(q: Array, memory: Memory, grad: Array) -> Array:
    newest_change = jnp.sum(memory.changes[-1] ** 2)
    return start_scale(memory.inverse_curvature[-1], newest_change, jnp.sum(grad**2)) * q


def _recur_forth(q: Array, pair_and_alpha: tuple[Memory, Array]) -> tuple[Array, None]:
    pair, alpha = pair_and_alpha
    beta = pair.inverse_curvature * jnp.sum(pair.changes * q)
    return q + pair.steps * (alpha - beta), None


def _scan_unrolled(
    function: Callable, carry: Array, inputs: PyTree, reverse: bool = False
) -> tuple[Array, list]:
    """Scan as `lax.scan`, without a loop; the results are in a list, which may be an input."""
    order, results = range(jax.tree.leaves(inputs)[0].shape[0]), []
    for k in reversed(order) if reverse else order:
        entry = jax.tree.map(lambda x, k=k: x[k], inputs, is_leaf=lambda x: isinstance(x, list))
        carry, result = function(carry, entry)
        results.append(result)
    return carry, results[::-1] if reverse else results


@functools.cache
def _turn(num_pairs: int, step_cap: float) -> Callable:

    def turn(memory: Memory, step: Array, change: Array, grad: Array) -> tuple[Memory, Array]:
        memory = remember(memory, step, change)
        return memory, search_direction(memory, grad, step_cap)

    return with_kernel(turn, "planner_jax.optimise.lbfgs_kernel:turn_kernel", num_pairs, step_cap)


def step(objective: Objective, state: LbfgsState, config: LbfgsConfig) -> LbfgsState:
    """Return the state after one iteration of L-BFGS.

    An iteration evaluates the gradient, updates the memory of pairs, computes a direction, and
    takes the trial step along it with the least cost. A finished problem of a batch keeps its
    point; its memory and gradient are updated, but not used.
    """
    here, grad = evaluate(objective, state.point)
    memory, direction = _turn(config.memory, config.step_cap)(
        state.memory, state.step, grad - state.grad, grad
    )
    return try_steps(objective, config, state, here, grad, memory, direction)


def evaluate(objective: Objective, point: Array) -> tuple[Evaluation, Array]:
    """Return the objective and its gradient (n,) at a point (n,)."""

    def value(point: Array) -> tuple[Array, Evaluation]:
        evaluation = objective(point)
        return evaluation.cost, evaluation

    (_, evaluation), grad = jax.value_and_grad(value, has_aux=True)(point)
    return evaluation, grad


def try_steps(
    objective: Objective,
    config: LbfgsConfig,
    state: LbfgsState,
    here: Evaluation,
    grad: Array,
    memory: Memory,
    direction: Array,
) -> LbfgsState:
    """Return the state after the trial step along a direction (n,) with the least cost."""
    lengths = state.numbers.reach * jnp.asarray(config.trial_steps, grad.dtype)
    trials = jax.vmap(lambda length: objective(state.point + length * direction))(lengths)
    choice = _choose(config, state.numbers, here, lengths, trials)
    step = jnp.where(choice.going, choice.length * direction, state.step)
    point = jnp.where(choice.going, state.point + step, state.point)
    return LbfgsState(
        point=point,
        step=step,
        grad=grad,
        memory=memory,
        best_point=jnp.where(choice.better, point, state.best_point),
        numbers=choice.numbers,
    )


def is_unfinished(numbers: LbfgsNumbers, config: LbfgsConfig) -> Array:
    """Return whether a problem has iterations left and is not stationary, () bool."""
    return (numbers.iteration < config.max_steps) & ~is_stationary(numbers, config)


def is_stationary(numbers: LbfgsNumbers, config: LbfgsConfig) -> Array:
    """Return whether `patience` iterations in a row hardly lowered the cost, () bool."""
    return numbers.stalled >= config.patience


@struct.dataclass
class _Choice:
    """The outcome of an iteration of L-BFGS: its step length, and scalars of the state after it."""

    numbers: LbfgsNumbers  # after the iteration
    length: Array  # (), factor on the direction; 0 without a decrease
    better: Array  # () bool, whether the new point is the best one
    going: Array  # () bool, False for a finished problem, which keeps its point


def _choose(
    config: LbfgsConfig, numbers: LbfgsNumbers, here: Evaluation, lengths: Array, trials: Evaluation
) -> _Choice:
    """Select the trial step to the least cost, if it costs less than the current point `here`."""
    costs = jnp.where(jnp.isfinite(trials.cost), trials.cost, jnp.inf)
    is_chosen = jnp.arange(costs.size) == jnp.argmin(costs)

    def of_chosen(values: Array) -> Array:  # a masked sum; a gather would need its own loop
        return jnp.sum(jnp.where(is_chosen, values, 0.0))

    decreased = of_chosen(costs) < here.cost
    there = jax.tree.map(lambda new, old: jnp.where(decreased, of_chosen(new), old), trials, here)
    best = jax.tree.map(lambda a, b: jnp.where(numbers.iteration == 0, a, b), here, numbers.best)
    is_best = is_better(there, best, tolerance=0.0) | ~jnp.isfinite(best.cost)
    tolerance = jnp.asarray(config.tolerance, here.cost.dtype)
    progress = here.cost - there.cost > tolerance * jnp.abs(here.cost)
    after = LbfgsNumbers(
        best=jax.tree.map(lambda a, b: jnp.where(is_best, a, b), there, best),
        # If no trial step lowers the cost, `reach` shortens the next iteration's trial steps.
        reach=jnp.where(decreased, 1.0, 0.05 * numbers.reach),
        iteration=numbers.iteration + 1,
        stalled=jnp.where(progress, 0, numbers.stalled + 1),
    )
    going = is_unfinished(numbers, config)
    return _Choice(
        numbers=jax.tree.map(lambda new, old: jnp.where(going, new, old), after, numbers),
        length=jnp.where(decreased, of_chosen(lengths), 0.0),
        better=is_best & going,
        going=going,
    )
