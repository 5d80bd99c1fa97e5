"""Derivatives of reaches whose motion has a closed form, for `pj.gradient` and `pj.optimal_plan`.

The duration of the fastest motion to a goal, and of the straight one, is a function of start, goal
and limits. Derivatives keep the goal, and the kind of motion, of a known plan. A motion that
shortcuts made along a searched path, or that torques slow down, has no closed form: its cost and
gradient are NaN.
"""

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.optimise.near import Known, NearPlan
from planner_jax.optimise.settings import Evaluation
from planner_jax.robot.arm_clearance import clearances
from planner_jax.robot.arm_motion import least_times
from planner_jax.task.reach import motion
from planner_jax.task.reach.case import ReachCase

if TYPE_CHECKING:
    from planner_jax.task.reach.default_planner import ReachPlan, ReachPlanner

_EQUAL = 1e-4  # greatest relative difference of equal durations


@struct.dataclass
class StartedReach(ReachCase, Known):
    """A reach to plan, and the index () of the goal and the duration () [s] of a known plan."""


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ClosedReach(NearPlan):
    """The duration of a fastest or straight motion; its single variable is zero at the minimum."""

    case_type: ClassVar[type] = StartedReach
    own: "ReachPlanner"

    def prepare(self, case: StartedReach) -> StartedReach:
        """Return the case with the limits that plans use."""
        return dataclasses.replace(case, limits=self.own.strict_limits(case))

    def known_of(self, cases: ReachCase, plans: "ReachPlan") -> tuple[Array, Array]:  # noqa: ARG002
        """Return the goals and the durations of plans."""
        return plans.goal, plans.cost

    def find_minimum(self, context: StartedReach) -> Array:
        """Return the minimum, (1,)."""
        return jnp.zeros(1, context.angles.dtype)

    def _durations(self, case: StartedReach) -> tuple[Array, Array]:
        """Return the duration () of the plan's kind of motion, and whether it is a straight one."""
        (goal, known), limits = lax.stop_gradient(case.known), case.limits
        turn = jnp.abs(case.goals[goal] - case.angles)
        at_rest = jnp.zeros_like(turn)
        alone = least_times(turn, at_rest, limits.velocity, limits.acceleration, ends_at_rest=True)
        points = jnp.stack([case.angles, case.goals[goal]])
        straight = jnp.sum(motion.straight_knots(points, limits)[0])
        fastest = jnp.max(alone[0])
        is_straight = jnp.abs(straight - known) < jnp.abs(fastest - known)
        duration = jnp.where(is_straight, straight, fastest)
        is_equal = jnp.abs(duration - known) <= _EQUAL * known
        return jnp.where(is_equal, duration, jnp.nan), is_straight

    def objective(self, point: Array, context: StartedReach) -> Evaluation:
        """Return the duration [s] as the cost; the plan at hand keeps all limits."""
        duration, _ = self._durations(context)
        return Evaluation(duration + 0.5 * jnp.sum(point**2), jnp.zeros_like(duration))

    def decode(self, point: Array, context: StartedReach) -> "ReachPlan":  # noqa: ARG002
        """Return the plan of the motion to the case's goal."""
        _, is_straight = self._durations(context)
        goal = context.known[0]
        points = jnp.stack([context.angles, context.goals[goal]])
        both = (
            motion.quickest_knots(points[0], points[1], context.limits),
            motion.straight_knots(points, context.limits),
        )
        padded = [motion.pad_knots(times, rates, self.own.pieces) for times, rates in both]
        knots = jax.tree.map(lambda a, b: jnp.where(is_straight, b, a), *padded)
        fixed, constant = lax.stop_gradient((context, knots))
        states = jnp.concatenate([fixed.angles[None], fixed.goals])
        rows = clearances(fixed.arm, fixed.scene, states)
        plan = self.own.finish(fixed, rows, goal, *constant)
        path = motion.join_knots(context.angles, knots[0], knots[1])
        return dataclasses.replace(plan, motion=path)
