"""The search loops of planners that minimise: several starts of one case, or a batch of cases."""

import dataclasses
import functools
import math
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.protocol import Status, index_of_best, is_unsolved, status_of
from planner_jax.lanes import over_lanes
from planner_jax.optimise import lbfgs
from planner_jax.optimise.settings import (
    COUNTED,
    Curvature,
    Curved,
    Evaluation,
    LbfgsConfig,
    NewtonConfig,
    Objective,
    Round,
    Solver,
    Stage,
)

if TYPE_CHECKING:
    from planner_jax.optimise.planner import OptimisedPlanner


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
        return _optimum_at(start, objective(start), config)
    if isinstance(config, NewtonConfig):
        config = _with_stragglers(config)
    step = lambda s: _step(objective, curved, s, config)  # noqa: E731
    state = _method(config).init(start, config)
    if _has_steps(config, 1):  # without a loop, so that XLA can fuse across the iteration
        return _optimum_of(step(state), config)
    state = lax.while_loop(lambda s: _method(config).is_unfinished(s.numbers, config), step, state)
    return _optimum_of(state, config)


def minimise_lanes(
    objective: Callable[[Array, PyTree], Evaluation],
    starts: Array,
    contexts: PyTree,
    config: Solver,
    curved: Callable[[Array, PyTree], Curvature] | None = None,
) -> Optimum:
    """Minimise many problems of a batch at once, each with its own start and context.

    The starts are (n, B). The B problems are on the last axis of every leaf of contexts and optima.
    `objective` and `curved` take one point and one context.
    """
    if _has_steps(config, 0):
        evaluate = lambda x, context: _optimum_at(x, objective(x, context), config)  # noqa: E731
        return over_lanes(evaluate)(starts, contexts)

    def search(state: PyTree, contexts: PyTree, config: Solver, steps: int | Array) -> PyTree:
        @over_lanes
        def step(state: PyTree, context: PyTree) -> PyTree:
            own = curved
            by_point = own and (lambda x: own(x, context))
            return _step(lambda x: objective(x, context), by_point, state, config)

        if isinstance(steps, int) and steps <= COUNTED:
            return lax.fori_loop(0, steps, lambda _, s: step(s, contexts), state)
        return lax.while_loop(
            lambda s: jnp.any(_method(config).is_unfinished(s.numbers, config)),
            lambda s: step(s, contexts),
            state,
        )

    state = over_lanes(lambda start: _method(config).init(start, config))(starts)
    state = search(state, contexts, config, config.max_steps)
    if isinstance(config, NewtonConfig) and config.stragglers is not None:
        newton, (share, steps, groups) = _method(config), config.stragglers
        longer, num = _with_stragglers(config), math.ceil(share * starts.shape[-1])

        def next_group(progress: tuple[Array, PyTree]) -> tuple[Array, PyTree]:
            number, state = progress
            lanes = newton.most_to_gain(state.numbers, longer, num)
            some, own = jax.tree.map(lambda leaf: leaf[..., lanes], (state, contexts))
            later = search(some, own, longer, steps)
            place = lambda old, new: old.at[..., lanes].set(new)  # noqa: E731
            return number + 1, jax.tree.map(place, state, later)

        def is_open(progress: tuple[Array, PyTree]) -> Array:
            number, state = progress
            return (number < groups) & jnp.any(newton.is_unfinished(state.numbers, longer))

        _, state = lax.while_loop(is_open, next_group, (jnp.zeros((), jnp.int32), state))
    return _optimum_of(state, config)


def _has_steps(config: Solver, num: int) -> bool:
    """Return whether `config.max_steps` is an integer, not a traced array, and equals `num`."""
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


def _with_stragglers(config: NewtonConfig) -> NewtonConfig:
    """Add the iterations of all groups of stragglers (slow problems) to `max_steps`."""
    if config.stragglers is None:
        return config
    _, steps, groups = config.stragglers
    return dataclasses.replace(config, max_steps=config.max_steps + steps * groups, stragglers=None)


def _optimum_of(state: PyTree, config: Solver) -> Optimum:
    return Optimum(
        point=state.best_point,
        evaluation=state.numbers.best,
        iterations=state.numbers.iteration,
        stationary=_method(config).is_stationary(state.numbers, config),
    )


def _optimum_at(point: Array, evaluation: Evaluation, config: Solver) -> Optimum:
    return Optimum(point, evaluation, jnp.zeros((), jnp.int32), jnp.full((), config.patience == 0))


def solve_round(planner: "OptimisedPlanner", attempt: Round, case: PyTree) -> PyTree:
    """Return the best plan of one case that one round (attempt) finds from its starts; pure."""
    last = planner.with_settings(attempt.settings)
    context = last.prepare(case)

    def search(problem: "OptimisedPlanner", solver: Solver, start: Array) -> Optimum:
        return minimise(
            lambda x: problem.objective(x, context),
            start,
            solver,
            lambda x: problem.curvature_at(x, context),
        )

    before = planner.with_settings(_stages(attempt)[0].settings)
    points = before.guesses(context, attempt.starts)
    spent = jnp.zeros(len(points), jnp.int32)
    optimum = None
    for stage in _stages(attempt):
        problem = planner.with_settings(stage.settings)
        points = _of_each(functools.partial(problem.convert_point, before=before), points)
        optimum = _of_each(functools.partial(search, problem, stage.solver), points)
        before = problem
        points, spent = optimum.point, spent + optimum.iterations
        if stage.keep is not None:
            kept = _cheapest(optimum.evaluation.cost, stage.keep)
            points, spent = points[kept], spent[kept]
    assert optimum is not None  # a round has at least one stage
    optimum = dataclasses.replace(optimum, iterations=spent)
    plans = _of_each(lambda found: _plan_at(last, found, context), optimum)
    return jax.tree.map(lambda leaf: leaf[0], plans) if len(points) == 1 else _best(plans)


def solve_batch(planner: "OptimisedPlanner", attempt: Round, cases: PyTree) -> PyTree:
    """Return the best plan of each case that one round (attempt) finds from its starts; pure."""
    last, num = planner.with_settings(attempt.settings), attempt.starts
    contexts = over_lanes(last.prepare)(jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), cases))
    before = planner.with_settings(_stages(attempt)[0].settings)
    starts = over_lanes(lambda context: before.guesses(context, num))(contexts)
    # Each start of each case is one problem of the solver; the starts of a case are adjacent.
    points = jnp.moveaxis(starts, 0, -1).reshape(starts.shape[1], -1)
    of_starts = _repeat(contexts, num)
    spent = jnp.zeros(points.shape[1:], jnp.int32)
    optimum = None
    for stage in _stages(attempt):
        problem = planner.with_settings(stage.settings)
        points = over_lanes(functools.partial(problem.convert_point, before=before))(points)
        before = problem
        optimum = minimise_lanes(
            problem.objective, points, of_starts, stage.solver, problem.curvature_at
        )
        points, spent = optimum.point, spent + optimum.iterations
        if stage.keep is not None:
            costs = optimum.evaluation.cost.reshape(-1, num)
            kept = jax.vmap(functools.partial(_cheapest, num=stage.keep))(costs)
            kept = (kept + num * jnp.arange(len(costs))[:, None]).ravel()
            points, spent, num = points[:, kept], spent[kept], min(stage.keep, num)
            of_starts = _repeat(contexts, num)
    assert optimum is not None  # a round has at least one stage
    optimum = dataclasses.replace(optimum, iterations=spent)
    plans = over_lanes(functools.partial(_plan_at, last))(optimum, of_starts)
    plans = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), plans)
    if num == 1:
        return plans
    split = lambda x: x.reshape(-1, num, *x.shape[1:])  # noqa: E731
    return jax.vmap(_best)(jax.tree.map(split, plans))


def _stages(attempt: Round) -> tuple[Stage, ...]:
    return (*attempt.stages, Stage(attempt.solver, attempt.settings))


def _of_each(function: Callable, starts: PyTree) -> PyTree:
    if len(jax.tree.leaves(starts)[0]) > 1:
        return jax.vmap(function)(starts)
    return jax.tree.map(lambda leaf: leaf[None], function(jax.tree.map(lambda x: x[0], starts)))


def _repeat(contexts: PyTree, num: int) -> PyTree:
    if num == 1:
        return contexts
    return jax.tree.map(lambda x: jnp.repeat(x, num, axis=-1), contexts)


def _cheapest(costs: Array, num: int) -> Array:
    """Return the indices (num,) of the `num` least costs; costs that are not finite come last."""
    return jnp.argsort(jnp.where(jnp.isfinite(costs), costs, jnp.inf))[:num]


def _plan_at(planner: "OptimisedPlanner", optimum: Optimum, context: PyTree) -> PyTree:
    plan = planner.decode(optimum.point, context)
    cost = optimum.evaluation.cost
    status = status_of(cost, plan.violation, optimum.stationary)
    hopeless = is_unsolved(status) & planner.rules_out(context)
    status = jnp.where(hopeless, jnp.int32(Status.TOO_FAR), status)
    return plan.replace(cost=cost, iterations=optimum.iterations, status=status)


def _best(plans: PyTree) -> PyTree:
    best = index_of_best(plans)
    return jax.tree.map(lambda leaf: leaf[best], plans)
