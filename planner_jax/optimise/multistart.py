"""The loop around the solver, for one scenario and several starts."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.optimise import lbfgs
from planner_jax.optimise.lbfgs import Evaluation, LbfgsConfig, Objective
from planner_jax.optimise.problem import Planner, Round, Settings
from planner_jax.optimise.status import Status

# Plans are refereed to 1e-3 of a limit; half of that is left for peaks between samples.
FEASIBILITY_TOLERANCE = 5e-4


@struct.dataclass
class Optimum:
    """Where one lane ended."""

    point: Array  # (n,), the best feasible iterate, or the least infeasible one
    evaluation: Evaluation
    iterations: Array  # () int32
    stationary: Array  # () bool


def minimise(objective: Objective, start: Array, config: LbfgsConfig) -> Optimum:
    """Minimise from one start until stationary or out of iterations."""

    def unfinished(state: lbfgs.LbfgsState) -> Array:
        return (state.iteration < config.max_steps) & (state.stalled < config.patience)

    state = jax.lax.while_loop(
        unfinished,
        lambda s: lbfgs.step(objective, s, config),
        lbfgs.init(objective, start, config),
    )
    return Optimum(
        point=state.best_point,
        evaluation=state.best,
        iterations=state.iteration,
        stationary=state.stalled >= config.patience,
    )


def changed(planner: Planner, settings: Settings) -> Planner:
    """The planner with some of its fields set anew; its plans keep their shape."""
    return dataclasses.replace(planner, **dict(settings))  # type: ignore[type-var]


def solve_round(planner: Planner, attempt: Round, scenario: Any) -> Any:
    """Plan one scenario with one round's starts and iterations; pure, so jit and vmap it.

    Args:
        planner: sizes and switches, static.
        attempt: how many starts and iterations.
        scenario: one case.

    Returns:
        The planner's plan of the best start, its `status` and `iterations` set.
    """
    stages = [changed(planner, stage.settings) for stage in attempt.stages]
    planner = changed(planner, attempt.settings)
    context = planner.prepare(scenario)
    starts = planner.guesses(context, attempt.starts)

    def from_start(start: Array) -> tuple[Any, Array]:
        iterations = jnp.zeros((), jnp.int32)
        for easier, stage in zip(stages, attempt.stages, strict=True):
            reached = minimise(lambda x: easier.objective(x, context), start, stage.solver)  # noqa: B023
            start, iterations = reached.point, iterations + reached.iterations
        optimum = minimise(lambda x: planner.objective(x, context), start, attempt.solver)
        plan = planner.decode(optimum.point, context)
        iterations += optimum.iterations
        plan = plan.replace(cost=optimum.evaluation.cost, iterations=iterations)
        return plan, optimum.stationary

    if attempt.starts == 1:
        plan, stationary = from_start(starts[0])
    else:
        plans, all_stationary = jax.vmap(from_start)(starts)
        feasible = plans.violation <= FEASIBILITY_TOLERANCE
        finite = jnp.isfinite(plans.cost) & jnp.isfinite(plans.violation)
        by_cost = jnp.where(feasible, plans.cost, jnp.inf)
        score = jnp.where(jnp.any(feasible & finite), by_cost, plans.violation)
        best = jnp.argmin(jnp.where(finite, score, jnp.inf))
        plan, stationary = jax.tree.map(lambda leaf: leaf[best], (plans, all_stationary))
    return plan.replace(status=status_of(plan.cost, plan.violation, stationary))


def status_of(cost: Array, violation: Array, stationary: Array) -> Array:
    """The `Status` of a finished lane, () int32."""
    feasible = violation <= FEASIBILITY_TOLERANCE
    status = jnp.where(
        feasible,
        jnp.where(stationary, Status.CONVERGED, Status.FEASIBLE),
        jnp.where(stationary, Status.INFEASIBLE, Status.MAX_STEPS),
    )
    finite = jnp.isfinite(cost) & jnp.isfinite(violation)
    return jnp.where(finite, status, Status.NON_FINITE).astype(jnp.int32)
