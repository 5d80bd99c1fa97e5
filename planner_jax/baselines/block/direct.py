"""The baseline `direct`: all joints as fast as they may turn, straight to an end pose, and stand.

No way is planned around anything: end poses are taken in the order in which the arm can be there,
and the first one that is in time and whose motion touches nothing is the plan. With `tries` of 1
only the pose is looked at that is reached soonest: no motion from rest to rest takes less time.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.baselines.parts.bang_bang import bang_bang, least_times
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt, first_solved, require_settings, status_of
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.clearance import least_clearances
from planner_jax.task.block.end_poses import EndPoses, end_poses, flight_of
from planner_jax.task.block.plan import BlockPlan, explain_status, make_empty_plan
from planner_jax.trajectory.polynomial import evaluate

_BANG_BANG_PIECES = 13  # of the motions of six joints
_PIECES = 10  # of the straight motions by which `end_poses` tells which poses there are


def poses_in_time(case: BlockCase, points: int) -> tuple[EndPoses, Array]:
    """End poses, and how long the joints take at least to be there.

    Args:
        case: one case.
        points: of the ball's way, where poses are looked at; eight each.

    Returns:
        The poses, and times (C,) [s] from the delay on, infinite where the arm would come after
        the ball or there is no pose.
    """
    poses = end_poses(case, flight_of(case), points, _PIECES)
    limits = case.limits
    take = jax.vmap(lambda q: least_times(q, case.rates, limits.velocity, limits.acceleration))
    times = jnp.max(take(poses.angles - case.angles), axis=1)
    is_in_time = jnp.isfinite(poses.effort) & (times <= poses.time - case.delay)
    return poses, jnp.where(is_in_time, times, jnp.inf)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class DirectBlock(Planner):
    """Bang-bang motions of the joints; the cost of a plan is its execution time [s]."""

    case_type: ClassVar[type] = BlockCase
    is_sequential: ClassVar[bool] = True
    attempts: ClassVar[tuple[Attempt, ...]] = (Attempt(),)  # pyright: ignore[reportIncompatibleMethodOverride]
    points: int = 48  # of the ball's way, where end poses are looked at
    tries: int = 384  # end poses whose motions are looked at, the soonest first
    samples: int = 96  # of a motion, where distances are looked at
    margin: float = 0.003  # [m], kept from everything

    def __post_init__(self) -> None:
        require_settings(self)

    def solve(self, case: BlockCase, attempt: Attempt) -> BlockPlan:
        """Return the plan of one case."""
        poses, times = poses_in_time(case, self.points)
        order = jnp.argsort(times)
        num = jnp.minimum(jnp.sum(jnp.isfinite(times)), self.tries)

        def plan_of(k: Array) -> BlockPlan:
            place = order[k]
            return self.plan_to(case, poses.angles[place], poses.time[place], times[place])

        best = first_solved(plan_of, num, make_empty_plan(case, _BANG_BANG_PIECES))
        return dataclasses.replace(best, status=explain_status(case, poses, best.status))

    def plan_to(self, case: BlockCase, goal: Array, contact: Array, duration: Array) -> BlockPlan:
        """Return the plan to one end pose.

        Args:
            case: one case.
            goal: (6,) [rad].
            contact: () [s], when the ball is there.
            duration: () [s], of the motion.
        """
        turn = goal - case.angles
        motion = bang_bang(case.angles, case.rates, turn, duration, case.limits.acceleration)
        shares = np.arange(1, self.samples + 1) / self.samples
        angles = jax.vmap(lambda share: evaluate(motion, share * duration))(shares)
        gaps = least_clearances(case.arm, case.scene, angles)
        # A joint that is moving at the start may have to go beyond its goal before it comes back.
        beyond = jnp.max(jnp.maximum(angles - case.arm.upper, case.arm.lower - angles))
        # A centimetre too near counts as much as a whole limit.
        violation = jnp.maximum(100.0 * (self.margin - jnp.min(gaps)), beyond)
        return BlockPlan(
            motion=motion,
            contact_time=contact,
            cost=duration,
            violation=violation,
            iterations=jnp.zeros((), jnp.int32),
            status=status_of(duration, violation, jnp.asarray(True)),
        )
