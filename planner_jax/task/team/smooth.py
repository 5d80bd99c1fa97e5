"""Teams whose plans `pj.gradient` differentiates, with the decisions of a known plan.

Each robot's catches are a minimum of the cost of catches, and its recovery trajectory is a minimum
that starts where the catches end. Which robot catches which targets, and in which order, is
constant. No robot avoids another one: a plan whose robots would then come too near to each other
violates the distance, and has no gradient.
"""

import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.origin import without_origin
from planner_jax.core.protocol import status_of
from planner_jax.optimise.composed import Composed
from planner_jax.optimise.implicit import implicit_point, newton_refine
from planner_jax.optimise.multistart import minimise
from planner_jax.optimise.near import Known
from planner_jax.optimise.planner import Problem
from planner_jax.optimise.settings import Evaluation, LbfgsConfig
from planner_jax.planning.replan import Replanning
from planner_jax.recovery.planner import RecoveryProblem
from planner_jax.recovery.with_recovery import recovery_cases
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.catch.replan import start_from
from planner_jax.task.team.case import TeamCase
from planner_jax.task.team.meeting import (
    hover_recovery,
    least_distances,
    with_stricter_limits,
)
from planner_jax.task.team.plan import TeamPlan

_NEAR = LbfgsConfig(max_steps=100, tolerance=1e-9, patience=6)
_STEPS = 100  # greatest number of Newton steps, each with the whole Hessian
_SLOPE = 1e-10  # norm of the gradient at which they end, divided by the cost


@struct.dataclass
class StartedTeam(TeamCase, Known):
    """A team to plan, and decisions and unknowns of the N robots in a known plan.

    `known` is a pair: a `CatchChoice`, with leaves (N, M), tells which targets each robot catches
    and when, and an array (N, n) has the unknowns of the robots' catches.
    """


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SmoothTeam(Composed):
    """The catches and recovery trajectories of the robots of a team, each a minimum of its own."""

    case_type: ClassVar[type] = StartedTeam
    catches: CatchProblem
    recovery: RecoveryProblem

    def num_minima(self, case: StartedTeam) -> int:
        """Return 2 N: the catches of N robots, then their recovery trajectories."""
        return 2 * case.num_robots

    def known_of(self, cases: TeamCase, plans: TeamPlan) -> tuple[CatchChoice, Array]:
        """Return decisions and unknowns of the robots' plans, of one team or a batch."""
        robots = dataclasses.replace(plans.robots, origin=None)
        return robots.choice, _encode(self.catches, cases, robots)

    def find_minimum(self, context: StartedTeam) -> Array:
        """Minimise the costs of all robots' catches and recoveries; return the minima, (n,)."""
        own = robots_of(context, context.known[0])
        points = jax.vmap(functools.partial(_minimise, self.catches))(own, context.known[1])
        cases = recovery_cases(own, jax.vmap(functools.partial(_decode, self.catches))(own, points))

        def recover(case: PyTree) -> Array:
            start = self.recovery.guesses(self.recovery.prepare(case), 1)[0]
            return _minimise(self.recovery, case, start)

        return jnp.concatenate([points.ravel(), jax.vmap(recover)(cases).ravel()])

    def compose(self, point: Array, case: StartedTeam, meters: Array) -> TeamPlan:
        """Return the plan of the minima `point` (n,), with derivatives by the case."""
        own, num = robots_of(case, case.known[0]), case.num_robots
        size = case.known[1].size
        of_catches, of_recovery = (each.reshape(num, -1) for each in jnp.split(point, [size]))
        plans = _plan_all(self.catches, own, of_catches, meters[:num])
        recoveries = _plan_all(self.recovery, recovery_cases(own, plans), of_recovery, meters[num:])
        hovers = plans.num_taken == 0
        idle = hover_recovery(case.head_states[:, 0], self.recovery.num_pieces)
        violation = jnp.maximum(plans.violation, jnp.where(hovers, -1.0, recoveries.violation))
        pick = lambda a, b: jnp.where(hovers.reshape(-1, *[1] * (a.ndim - 1)), a, b)  # noqa: E731
        plans = plans.replace(
            recovery=jax.tree.map(pick, idle, recoveries.trajectory),
            violation=violation,
            status=status_of(plans.cost, violation, True),
        ).with_heading(own)
        near = 1.0 - least_distances(plans.whole) / case.least_distance
        worst = jnp.maximum(jnp.max(violation), jnp.max(near))
        return TeamPlan(
            cost=jnp.sum(plans.cost),
            violation=worst,
            iterations=jnp.zeros((), jnp.int32),
            status=status_of(jnp.sum(plans.cost), worst, True),
            robots=plans.replace(origin=case.shared.origin),
        )


def robots_of(case: TeamCase, choices: CatchChoice) -> CatchCase:
    """Return the N robots' catch cases with their `choices`, all leaves with a leading axis N."""
    team = dataclasses.replace(case, shared=without_origin(case.shared))
    if case.num_robots > 1:
        team = with_stricter_limits(team)
    own = [
        team.of_robot(k).with_choice(jax.tree.map(lambda leaf: leaf[k], choices))  # noqa: B023
        for k in range(case.num_robots)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *own)


def _minimise(problem: Problem, case: PyTree, start: Array) -> Array:
    context = problem.prepare(case)
    objective = lambda x: Evaluation(*problem.objective(x, context))  # noqa: E731
    near = minimise(objective, start, _NEAR)
    slope = _SLOPE * jnp.abs(near.evaluation.cost)
    return newton_refine(objective, near.point, max_steps=_STEPS, stationarity=slope)[0]


def _decode(problem: Problem, case: PyTree, point: Array) -> PyTree:
    context = problem.prepare(case)
    plan = problem.decode(point, context)
    return plan.replace(cost=problem.objective(point, context)[0])


def _plan_all(problem: Problem, cases: PyTree, points: Array, meters: Array) -> PyTree:
    """Return the plans of N minima (N, n) of a problem, with derivatives by its N cases."""

    def plan(case: PyTree, point: Array, meter: Array) -> PyTree:
        return _decode(problem, case, implicit_point(problem, case, point, meter, 3, "whole"))

    return jax.vmap(plan)(cases, points, meters)


@functools.partial(jax.jit, static_argnums=0)
def _encode(catches: CatchProblem, cases: TeamCase, robots: CatchPlan) -> Array:
    """Return the unknowns (N, n) of the robots' known plans, or (B, N, n) of a batch."""

    def of_robot(case: CatchCase, plan: CatchPlan) -> Array:
        task = Replanning(case, plan, jnp.zeros_like(case.gravity))
        return start_from(catches, task, catches.prepare(case))

    def of_team(case: TeamCase, robots: CatchPlan) -> Array:
        return jax.vmap(of_robot)(robots_of(case, robots.choice), robots)

    return (of_team if cases.batch_shape == () else jax.vmap(of_team))(cases, robots)
