"""The baseline `direct`: bang-bang motions of all joints straight to an end pose, then standstill.

The planner does not steer round obstacles. It evaluates end poses, in which the shield meets the
ball, in the order in which the arm can reach them. The plan is the first motion that arrives before
the ball and touches nothing.
"""

import dataclasses
from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.baselines.parts.bang_bang import bang_bang
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import BaseAttempt, is_solved, require_settings, select, status_of
from planner_jax.robot.arm_clearance import least_clearances
from planner_jax.robot.arm_dynamics import measure_torques
from planner_jax.robot.arm_motion import least_times
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan, explain_status, make_empty_plan, mark_blocked
from planner_jax.task.block.problem.end_poses import EndPoses, end_poses
from planner_jax.task.block.problem.flight import flight_of
from planner_jax.trajectory.polynomial import evaluate

_PIECES = 10  # number of polynomial pieces of the straight motions that `end_poses` evaluates


def poses_in_time(case: BlockCase, points: int) -> tuple[EndPoses, Array]:
    """Return end poses in which the shield meets the ball, and bang-bang motions' durations.

    Args:
        case: one case.
        points: number of points of the ball's trajectory, each with eight end poses.

    Returns:
        C = 8 * points end poses, and durations (C,) [s] of the quickest bang-bang motions to them.
        A duration is infinite if the arm would come after the ball, or if the pose does not exist.
    """
    poses = end_poses(case, flight_of(case), points, _PIECES)
    limits = case.limits
    given = case.rates, limits.velocity, limits.acceleration, True
    times = jnp.max(
        jax.vmap(lambda turn: least_times(turn, *given)[0])(poses.angles - case.angles), axis=1
    )
    is_in_time = jnp.isfinite(poses.effort) & (times <= poses.time - case.delay)
    return poses, jnp.where(is_in_time, times, jnp.inf)


def select_first_solved(
    plan_of: Callable[[Array], BlockPlan], num: Array | int, best: BlockPlan
) -> BlockPlan:
    """Return the first solved plan in a sequence of plans of one case, or else the best; pure.

    `plan_of` makes the plan at a position () int32 below `num`. If the existing plan `best` is
    solved already, no other plan is made.
    """

    def next_one(state: tuple[Array, BlockPlan]) -> tuple[Array, BlockPlan]:
        position, best = state
        return position + 1, select(plan_of(position), best)

    def is_open(state: tuple[Array, BlockPlan]) -> Array:
        position, best = state
        return (position < num) & ~is_solved(best.status)

    return lax.while_loop(is_open, next_one, (jnp.zeros((), jnp.int32), best))[1]


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class DirectBlock(Planner):
    """The planner `direct`: bang-bang joint motions to end poses; the cost is the duration [s]."""

    case_type: ClassVar[type] = BlockCase
    is_sequential: ClassVar[bool] = True
    attempts: ClassVar[tuple[BaseAttempt, ...]] = (BaseAttempt(),)  # pyright: ignore[reportIncompatibleMethodOverride]
    points: int = 48  # number of points of the ball's trajectory, each with eight end poses
    tries: int = 384  # greatest number of evaluated end poses, earliest arrival first
    samples: int = 96  # number of samples of a motion at which obstacle distances are computed
    margin: float = 0.003  # [m], least distance from obstacles and from the arm itself

    def __post_init__(self) -> None:
        require_settings(self)

    def solve(self, case: BlockCase, attempt: BaseAttempt) -> BlockPlan:
        """Return the plan of one case: the first collision-free motion in time for the ball."""
        poses, times = poses_in_time(case, self.points)
        order = jnp.argsort(times)
        num = jnp.minimum(jnp.sum(jnp.isfinite(times)), self.tries)

        def plan_of(k: Array) -> BlockPlan:
            index = order[k]
            return self.plan_to(case, poses.angles[index], poses.time[index], times[index])

        best = select_first_solved(plan_of, num, make_empty_plan(case, 2 * case.arm.num + 1))
        status = explain_status(poses, mark_blocked(case, best.status))
        return dataclasses.replace(best, status=status)

    def plan_to(self, case: BlockCase, goal: Array, contact: Array, duration: Array) -> BlockPlan:
        """Return the bang-bang motion to one end pose as a plan.

        The plan's violation is the excess [rad] over a position limit, the relative excess over a
        torque limit, or 100 times the lack [m] of distance from obstacles, whichever is greatest.

        Args:
            case: one case.
            goal: (6,) [rad], joint angles of the end pose.
            contact: () [s], when the ball arrives at the shield in this pose.
            duration: () [s], duration of the motion.
        """
        turn = goal - case.angles
        motion = bang_bang(case.angles, case.rates, turn, duration, case.limits.acceleration)
        shares = np.arange(1, self.samples + 1) / self.samples
        angles = jax.vmap(lambda share: evaluate(motion, share * duration))(shares)
        gaps = least_clearances(case.arm, case.scene, angles)
        # A joint that moves at the start may overshoot its goal and a position limit.
        beyond = jnp.max(jnp.maximum(angles - case.arm.upper, case.arm.lower - angles))
        violation = jnp.maximum(100.0 * (self.margin - jnp.min(gaps)), beyond)
        if case.limits.torque is not None:
            of_case = case.arm, case.limits, case.gravity
            violation = jnp.maximum(violation, measure_torques(*of_case, motion, self.samples)[0])
        return BlockPlan(
            motion=motion,
            contact_time=contact,
            cost=duration,
            violation=violation,
            iterations=jnp.zeros((), jnp.int32),
            status=status_of(duration, violation, jnp.asarray(True)),
        )
