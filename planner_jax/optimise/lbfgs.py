"""L-BFGS for small smooth problems, many at once.

The functions solve ONE problem; `jax.vmap` makes a batch, in which finished lanes stand still. Each
iteration tries several step lengths at once, because under `vmap` a backtracking search would
continue until the slowest lane is done. The solver also tracks feasibility, and returns the best
feasible iterate.

Direction: [Liu1989], two-loop recursion, with gamma = s.y / y.y of the newest pair.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.core.protocol import is_better
from planner_jax.lanes import with_kernel
from planner_jax.optimise.settings import Evaluation, LbfgsConfig, Objective


@struct.dataclass
class Memory:
    """The newest m pairs of steps and changes of the gradient, newest last."""

    steps: Array  # (m, n), s_k of Liu and Nocedal
    changes: Array  # (m, n), y_k
    inverse_curvature: Array  # (m,), 1 / s.y; 0 where the slot is empty


@struct.dataclass
class LbfgsNumbers:
    """The scalars in the state of one lane."""

    best: Evaluation  # at the best point; not finite before the first iteration
    reach: Array  # (), factor on the trial steps; shrinks while none lowers the cost
    iteration: Array  # () int32
    stalled: Array  # () int32, iterations in a row without a decrease


@struct.dataclass
class LbfgsState:
    """The state of one lane between iterations."""

    point: Array  # (n,)
    step: Array  # (n,), last step, which led to the point; 0 if there was none
    grad: Array  # (n,), at the start of the last step
    memory: Memory
    best_point: Array  # (n,)
    numbers: LbfgsNumbers


def init(point: Array, config: LbfgsConfig) -> LbfgsState:
    """Return the state before the first iteration; nothing is evaluated."""
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
    """Return the weight of a new pair, given s.y, y.y and s.s.

    The results are whether its curvature is positive, so that the pair is kept; whether the squared
    length of the step is not zero; and 1 / s.y if the pair is kept, otherwise 0.
    """
    keep = curvature > 1e-8 * change
    return keep, step > 0.0, jnp.where(keep, 1.0 / jnp.where(keep, curvature, 1.0), 0.0)


def start_scale(newest: Array, change: Array, grad: Array) -> Array:
    """Return gamma, given 1 / s.y (0 without a pair) and y.y of the newest pair, and g.g."""
    size = change * newest
    slope = jnp.sqrt(jnp.maximum(grad, 1e-30))
    return jnp.where(newest > 0.0, 1.0 / jnp.where(newest > 0.0, size, 1.0), 1.0 / slope)


def shortening(squared_length: Array, step_cap: float) -> Array:
    """Return the factor that limits a direction to the length `step_cap`."""
    return jnp.minimum(1.0, step_cap / jnp.sqrt(jnp.maximum(squared_length, 1e-30)))


def remember(memory: Memory, step: Array, change: Array) -> Memory:
    """Return the memory with another pair (n,), (n,).

    A pair without positive curvature is left out. If the squared length of the step is zero, the
    memory is emptied, so that the next direction is steepest descent.
    """
    keep, moved, inverse = weigh_pair(jnp.sum(step * change), jnp.sum(change**2), jnp.sum(step**2))

    def push(old: Array, new: Array) -> Array:
        pushed = jnp.concatenate([old[1:], new[None]])
        return jnp.where(keep, pushed, jnp.where(moved, old, 0.0))

    return Memory(
        steps=push(memory.steps, step),
        changes=push(memory.changes, change),
        inverse_curvature=push(memory.inverse_curvature, inverse),
    )


def search_direction(memory: Memory, grad: Array, step_cap: float) -> Array:
    """Return the quasi-Newton direction -H g (n,), at most as long as the step cap.

    Without a pair in memory it is steepest descent of unit length: in scaled variables one is a
    sensible length of a step, for any size of the gradient.
    """
    q = grad
    alphas = []
    pairs = range(memory.steps.shape[0])
    for k in reversed(pairs):
        alpha = memory.inverse_curvature[k] * jnp.sum(memory.steps[k] * q)
        q = q - alpha * memory.changes[k]
        alphas.append(alpha)
    newest_change = jnp.sum(memory.changes[-1] ** 2)
    q = start_scale(memory.inverse_curvature[-1], newest_change, jnp.sum(grad**2)) * q
    for k, alpha in zip(pairs, reversed(alphas), strict=True):
        beta = memory.inverse_curvature[k] * jnp.sum(memory.changes[k] * q)
        q = q + memory.steps[k] * (alpha - beta)
    return -q * shortening(jnp.sum(q**2), step_cap)


@functools.cache
def _turn(num_pairs: int, step_cap: float) -> Callable:
    """Return the function that updates memory and direction, with a kernel for many lanes."""

    def turn(memory: Memory, step: Array, change: Array, grad: Array) -> tuple[Memory, Array]:
        memory = remember(memory, step, change)
        return memory, search_direction(memory, grad, step_cap)

    path = "planner_jax.optimise.lbfgs_kernel:turn_kernel"
    return with_kernel(turn, path, num_pairs, step_cap)


def step(objective: Objective, state: LbfgsState, config: LbfgsConfig) -> LbfgsState:
    """Return the state after one iteration: gradient, memory, direction, and the best trial step.

    The gradient is evaluated first, so that k iterations take exactly k gradients. A finished lane
    stands still: of its state only memory and gradient change, which it does not use again.
    """

    def value(point: Array) -> tuple[Array, Array]:
        evaluation = objective(point)
        return evaluation.cost, evaluation.violation

    (cost, violation), grad = jax.value_and_grad(value, has_aux=True)(state.point)
    memory, direction = _turn(config.memory, config.step_cap)(
        state.memory, state.step, grad - state.grad, grad
    )
    lengths = state.numbers.reach * jnp.asarray(config.trial_steps, grad.dtype)
    trials = jax.vmap(lambda length: objective(state.point + length * direction))(lengths)
    here = Evaluation(cost, violation)
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
    """Return whether a lane has iterations left and is not stationary, () bool."""
    return (numbers.iteration < config.max_steps) & ~is_stationary(numbers, config)


def is_stationary(numbers: LbfgsNumbers, config: LbfgsConfig) -> Array:
    """Return whether `patience` iterations in a row brought no decrease, () bool."""
    return numbers.stalled >= config.patience


@struct.dataclass
class _Choice:
    """The result of an iteration."""

    numbers: LbfgsNumbers  # after the iteration
    length: Array  # (), factor on the direction; 0 without a decrease
    better: Array  # () bool, whether the new point is the best one
    going: Array  # () bool, False for a finished lane, which stands still


def _choose(
    config: LbfgsConfig, numbers: LbfgsNumbers, here: Evaluation, lengths: Array, trials: Evaluation
) -> _Choice:
    """Select the lowest of the trials (k,), if it is lower than the cost at the current point."""
    costs = jnp.where(jnp.isfinite(trials.cost), trials.cost, jnp.inf)
    is_chosen = jnp.arange(costs.size) == jnp.argmin(costs)

    def of_chosen(values: Array) -> Array:  # a gather would need a loop of its own
        return jnp.sum(jnp.where(is_chosen, values, 0.0))

    decreased = of_chosen(costs) < here.cost
    there = jax.tree.map(lambda new, old: jnp.where(decreased, of_chosen(new), old), trials, here)
    best = jax.tree.map(lambda a, b: jnp.where(numbers.iteration == 0, a, b), here, numbers.best)
    is_best = is_better(there, best, tolerance=0.0) | ~jnp.isfinite(best.cost)
    progress = here.cost - there.cost > config.tolerance * jnp.abs(here.cost)
    after = LbfgsNumbers(
        best=jax.tree.map(lambda a, b: jnp.where(is_best, a, b), there, best),
        # Without a decrease the next trial steps are shorter.
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
