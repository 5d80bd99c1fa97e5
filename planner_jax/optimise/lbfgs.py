"""L-BFGS for small smooth problems, many at once.

Written for ONE problem; `jax.vmap` makes a batch, in which finished lanes stand still. Each
iteration tries several step lengths at once, because under `vmap` a backtracking search would
run to the slowest lane. Feasibility is watched beside the cost, and the best feasible iterate
is what comes back.

Direction: Liu and Nocedal 1989, two-loop recursion, with gamma = s.y / y.y of the newest pair.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array


@struct.dataclass
class Evaluation:
    """An objective at one point."""

    cost: Array  # (), what is minimised
    violation: Array  # (), largest relative excess over a limit; <= 0 is feasible


Objective = Callable[[Array], Evaluation]


@dataclasses.dataclass(frozen=True)
class LbfgsConfig:
    """Sizes and switches of the solver: hashable, so static under jit."""

    max_steps: int = 10
    memory: int = 6
    trial_steps: tuple[float, ...] = (1.0, 2.5, 0.3)
    step_cap: float = 2.0  # largest Euclidean length of a unit step
    tolerance: float = 1e-4  # relative decrease of the cost that counts as none
    patience: int = 2  # iterations without a decrease before a lane is stationary

    def __post_init__(self) -> None:
        if self.max_steps < 0:
            raise ValueError(f"max_steps must be >= 0, got {self.max_steps}")
        if self.memory < 1:
            raise ValueError(f"memory must be >= 1, got {self.memory}")


@struct.dataclass
class LbfgsState:
    """What one lane carries from iteration to iteration."""

    point: Array  # (n,)
    cost: Array  # ()
    grad: Array  # (n,)
    steps: Array  # (m, n), newest last: s_k of Liu and Nocedal
    changes: Array  # (m, n), y_k
    inverse_curvature: Array  # (m,), 1 / s.y; 0 where the slot is empty
    best_point: Array  # (n,)
    best: Evaluation
    reach: Array  # (), multiplies the trial steps: shrinks while none lowers the cost
    iteration: Array  # () int32
    stalled: Array  # () int32, iterations in a row without a decrease


def _value(objective: Objective, point: Array) -> tuple[Array, Array]:
    evaluation = objective(point)
    return evaluation.cost, evaluation.violation


def _better(a: Evaluation, b: Evaluation) -> Array:
    """Whether a beats b: feasible before infeasible, then cost, or violation if neither is."""
    both = (a.violation <= 0.0) & (b.violation <= 0.0)
    by_cost = a.cost < b.cost
    by_violation = jnp.maximum(a.violation, 0.0) < jnp.maximum(b.violation, 0.0)
    return jnp.where(both, by_cost, by_violation) | ~jnp.isfinite(b.cost)


def init(objective: Objective, point: Array, config: LbfgsConfig) -> LbfgsState:
    """State before the first iteration."""
    (cost, violation), grad = jax.value_and_grad(lambda x: _value(objective, x), has_aux=True)(
        point
    )
    empty = jnp.zeros((config.memory, point.shape[0]), point.dtype)
    return LbfgsState(
        point=point,
        cost=cost,
        grad=grad,
        steps=empty,
        changes=empty,
        inverse_curvature=empty[:, 0],
        best_point=point,
        best=Evaluation(cost, violation),
        reach=jnp.ones((), point.dtype),
        iteration=jnp.zeros((), jnp.int32),
        stalled=jnp.zeros((), jnp.int32),
    )


def search_direction(state: LbfgsState, config: LbfgsConfig) -> Array:
    """Quasi-Newton direction -H g, no longer than the step cap, (n,).

    Without a pair in memory it is the steepest descent of unit length: in scaled variables
    one is the size of a sensible step, whatever the size of the gradient.
    """
    q = state.grad
    alphas = []
    for k in reversed(range(config.memory)):
        alpha = state.inverse_curvature[k] * jnp.sum(state.steps[k] * q)
        q = q - alpha * state.changes[k]
        alphas.append(alpha)
    newest = state.inverse_curvature[-1]
    size = jnp.sum(state.changes[-1] ** 2) * newest
    slope = jnp.sqrt(jnp.maximum(jnp.sum(state.grad**2), 1e-30))
    gamma = jnp.where(newest > 0.0, 1.0 / jnp.where(newest > 0.0, size, 1.0), 1.0 / slope)
    q = gamma * q
    for k, alpha in zip(range(config.memory), reversed(alphas), strict=True):
        beta = state.inverse_curvature[k] * jnp.sum(state.changes[k] * q)
        q = q + state.steps[k] * (alpha - beta)
    length = jnp.sqrt(jnp.maximum(jnp.sum(q**2), 1e-30))
    return -q * jnp.minimum(1.0, config.step_cap / length)


def step(objective: Objective, state: LbfgsState, config: LbfgsConfig) -> LbfgsState:
    """One iteration: direction, all trial steps at once, the lowest kept, memory updated."""
    direction = search_direction(state, config)
    trials = state.reach * jnp.asarray(config.trial_steps, state.point.dtype)
    costs = jax.vmap(lambda a: objective(state.point + a * direction).cost)(trials)
    costs = jnp.where(jnp.isfinite(costs), costs, jnp.inf)
    chosen = jnp.argmin(costs)
    decreased = costs[chosen] < state.cost
    # Without a decrease the lane stands still and forgets its curvature: the next direction
    # is steepest descent, and looks nearer.
    taken = jnp.where(decreased, trials[chosen], 0.0)
    point = state.point + taken * direction
    (cost, violation), grad = jax.value_and_grad(lambda x: _value(objective, x), has_aux=True)(
        point
    )
    s = point - state.point
    y = grad - state.grad
    curvature = jnp.sum(s * y)
    keep = curvature > 1e-8 * jnp.sum(y**2)
    inverse = jnp.where(keep, 1.0 / jnp.where(keep, curvature, 1.0), 0.0)

    def push(old: Array, new: Array) -> Array:
        pushed = jnp.concatenate([old[1:], new[None]])
        return jnp.where(keep, pushed, jnp.where(decreased, old, 0.0))

    here = Evaluation(cost, violation)
    better = _better(here, state.best)
    progress = state.cost - cost > config.tolerance * jnp.abs(state.cost)
    return LbfgsState(
        point=point,
        cost=cost,
        grad=grad,
        steps=push(state.steps, s),
        changes=push(state.changes, y),
        inverse_curvature=push(state.inverse_curvature, inverse),
        best_point=jnp.where(better, point, state.best_point),
        best=jax.tree.map(lambda a, b: jnp.where(better, a, b), here, state.best),
        reach=jnp.where(decreased, 1.0, 0.05 * state.reach),
        iteration=state.iteration + 1,
        stalled=jnp.where(progress, 0, state.stalled + 1),
    )
