"""Groups whose plans `pj.gradient` differentiates, at the order of targets of a known plan.

Each leg, the drive to one target, is a minimum of its own cost (`intercept.problem.smooth`). It
starts where the minimum of the leg before it ends. The order of the targets is constant.
"""

import dataclasses
from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.optimise.composed import Composed
from planner_jax.optimise.implicit import implicit_point
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.optimise.near import Known
from planner_jax.optimise.planner import SearchPlanner
from planner_jax.task.group.case import InterceptGroup
from planner_jax.task.group.legs import chain_legs
from planner_jax.task.group.plan import GroupPlan
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.problem.motion_problem import MotionProblem
from planner_jax.task.intercept.problem.smooth import SmoothIntercept, StartedCase

# Most legs end after 100 to 600 steps; a leg that exceeds a limit would make all steps.
_SOLVER = LevenbergConfig(1000, settled=12, tolerance=0.0)


@struct.dataclass
class StartedGroup(InterceptGroup, Known):
    """A group to plan, and the unknowns (N, n) of the legs of a known plan, ordered by `order`."""


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class SmoothGroup(Composed):
    """The legs of groups, each a minimum of the cost `leg` from the leg of a known plan."""

    case_type: ClassVar[type] = StartedGroup
    leg: SmoothIntercept

    def num_minima(self, case: StartedGroup) -> int:
        """Return the number N of legs."""
        return case.num_targets

    def known_of(self, cases: InterceptGroup, plans: GroupPlan) -> Array:
        """Return the unknowns (..., N, n) of the legs of plans."""
        return self.leg.known_of(cases.shared, plans.legs)

    def near(self, cases: InterceptGroup, plans: GroupPlan) -> tuple[SearchPlanner, StartedGroup]:
        """Return a planner and cases, with the plans' order, by which plans are differentiated."""
        return super().near(cases.with_choice(plans.choice), plans)

    def find_minimum(self, context: StartedGroup) -> Array:
        """Minimise the costs of the legs, one after another; return the minima, (N n,)."""

        def minimise(leg: StartedCase, needed: Array, k: Array | int) -> Array:
            steps = jnp.where(needed, self.leg.solver.max_steps, 0)
            solver = dataclasses.replace(self.leg.solver, max_steps=steps)
            problem = dataclasses.replace(self.leg, solver=solver)
            return problem.guesses(problem.prepare(leg), 1)[0]

        return self._drive(context, minimise)[0].ravel()

    def compose(self, point: Array, case: StartedGroup, meters: Array) -> GroupPlan:
        """Return the plan of the legs' minima `point` (N n,), with derivatives by the case."""
        points = point.reshape(case.num_targets, -1)

        def point_of(leg: StartedCase, needed: Array, k: Array | int) -> Array:
            return implicit_point(self.leg, leg, points[k], meters[k])

        return self._drive(case, point_of)[1]

    def _drive(
        self, case: StartedGroup, point_of: Callable[[StartedCase, Array, Array | int], Array]
    ) -> tuple[Array, GroupPlan]:
        """Return the points (N, n) of the legs, which `point_of` finds, and the plan."""

        def plan_legs(
            legs: InterceptCase, needed: Array, k: Array | int
        ) -> tuple[InterceptPlan, Array]:
            def plan(leg: InterceptCase, needed: Array) -> tuple[InterceptPlan, Array]:
                started = StartedCase(**vars(leg), known=case.known[k])
                point = point_of(started, needed, k)
                return self.leg.decode(point, self.leg.prepare(started)), point

            return jax.vmap(plan)(legs, needed)

        one = jax.tree.map(lambda leaf: leaf[None], case)
        plans, points = chain_legs(one, plan_legs, is_pure=True)
        return points[:, 0], jax.tree.map(lambda leaf: leaf[0], plans)


def smooth_legs(problem: MotionProblem) -> SmoothGroup:
    """Return the problem that minimises every leg by the cost of `problem`."""
    return SmoothGroup(SmoothIntercept(problem, _SOLVER))
