"""The search loop of planners that minimise for one problem, and plans at its result."""

from types import ModuleType
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.protocol import Status, is_unsolved, status_of
from planner_jax.optimise import lbfgs
from planner_jax.optimise.settings import (
    Curved,
    Evaluation,
    LbfgsConfig,
    NewtonConfig,
    Objective,
    Solver,
)

if TYPE_CHECKING:
    from planner_jax.optimise.planner import Problem


@struct.dataclass
class Optimum:
    """The result of a search from one start of one case."""

    point: Array  # (n,), the best feasible iterate, or the iterate of least violation
    evaluation: Evaluation
    iterations: Array  # () int32
    stationary: Array  # () bool


def minimise(
    objective: Objective, start: Array, config: Solver, curved: Curved | None = None
) -> Optimum:
    """Minimise from one start (n,) until the point is stationary or no iterations are left.

    `curved` returns the derivatives for Newton's method. By default these are computed from the
    objective, with one automatic differentiation for each product with the Hessian.
    """
    if _has_steps(config, 0):
        return optimum_at(start, objective(start), config)
    if isinstance(config, NewtonConfig):
        config = _method(config).with_stragglers(config)
    step = lambda s: _step(objective, curved, s, config)  # noqa: E731
    state = _method(config).init(start, config)
    if _has_steps(config, 1):  # without a loop, so that XLA can fuse across the iteration
        return optimum_of(step(state), config)
    state = lax.while_loop(lambda s: _method(config).is_unfinished(s.numbers, config), step, state)
    return optimum_of(state, config)


def _has_steps(config: Solver, num: int) -> bool:
    return isinstance(config.max_steps, int) and config.max_steps == num


def _method(config: Solver) -> ModuleType:
    if isinstance(config, LbfgsConfig):
        return lbfgs
    from planner_jax.optimise import newton  # only planners that search for low costs use it

    return newton


def _step(objective: Objective, curved: Curved | None, state: PyTree, config: Solver) -> PyTree:
    if isinstance(config, LbfgsConfig):
        return lbfgs.step(objective, state, config)
    newton = _method(config)
    return newton.step(objective, curved or newton.by_products(objective), state, config)


def optimum_of(state: PyTree, config: Solver) -> Optimum:
    """Return the result of a search in its last state."""
    return Optimum(
        point=state.best_point,
        evaluation=state.numbers.best,
        iterations=state.numbers.iteration,
        stationary=_method(config).is_stationary(state.numbers, config),
    )


def optimum_at(point: Array, evaluation: Evaluation, config: Solver) -> Optimum:
    """Return the result of a search of 0 iterations at a point (n,) with this evaluation."""
    return Optimum(point, evaluation, jnp.zeros((), jnp.int32), jnp.full((), config.patience == 0))


def start_at(point: Array) -> Optimum:
    """Return the result of a search of 0 iterations, whose cost is not evaluated."""
    nothing, zero = jnp.zeros((), point.dtype), jnp.zeros((), jnp.int32)
    return Optimum(point, Evaluation(nothing, nothing), zero, jnp.zeros((), bool))


def put_lanes_last(cases: PyTree) -> PyTree:
    """Return a batch with its lanes (cases) on the last axis instead of the first."""
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), cases)


def put_lanes_first(plans: PyTree) -> PyTree:
    """Return a batch with its lanes (cases) on the first axis instead of the last."""
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), plans)


def plan_at(problem: "Problem", optimum: Optimum, context: PyTree) -> PyTree:
    """Return the plan at the point where a search has ended, with its status."""
    plan = problem.decode(optimum.point, context)
    cost = optimum.evaluation.cost
    status = status_of(cost, plan.violation, optimum.stationary)
    hopeless = is_unsolved(status) & problem.rules_out(context)
    status = jnp.where(hopeless, jnp.int32(Status.TOO_FAR), status)
    return plan.replace(cost=cost, iterations=optimum.iterations, status=status)
