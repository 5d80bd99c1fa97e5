"""Reasons why an arm does not block a ball: no pose, no clear pose, or no clear pose in time."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.checks import require_kind
from planner_jax.core.choices import require
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.end_poses import end_poses, flight_of
from planner_jax.task.block.motion import least_times

_POINTS, _PIECES = (
    192,
    10,
)  # points of the ball's path for which poses are computed; see `end_poses`


@dataclasses.dataclass(frozen=True)
class Prospects:
    """Numbers of poses in which an arm meets a ball, and the time that the arm lacks.

    In a pose the shield meets the ball where it may be blocked. Inverse kinematics find the poses
    at 192 points of the ball's path. Obstacles between start and poses are ignored.
    """

    poses: int  # number of poses within the limits of the joint angles
    clear: int  # number of these poses in which the arm touches nothing
    # [s], time by which the ball would have to come later for the clear pose that is reached
    # soonest, negative if this pose is reached early. Each joint is given its own least time by its
    # limits, and obstacles on the way are ignored. Infinite if there is no clear pose.
    later: float

    def sentence(self) -> str:
        """Describe why the ball cannot be blocked, or that a search for a motion may succeed."""
        if not self.poses:
            return "the shield cannot get to the ball's path between the two boxes"
        if not self.clear:
            return f"the arm touches something in all {self.poses} poses that meet the ball"
        if self.later > 0.0:
            return f"the ball is too early: the arm is ready {self.later:.3f} s after it"
        return (
            f"{self.clear} of {self.poses} poses that meet the ball are clear, and one is reached "
            f"{-self.later:.3f} s early if nothing is in the way"
        )


def prospects(case: BlockCase) -> Prospects:
    """Return whether poses of the arm meet the ball, are free of collisions, and are in time.

    Use the function for a case that no planner solves. If a clear pose is in time, either the
    search failed, or no way round the obstacles is short enough.

    Args:
        case: one case.

    Raises:
        ValueError: there is a batch of cases instead of one case.
        TypeError: the case is not a `BlockCase`.
    """
    require_kind("case", case, BlockCase)
    require(case.batch_shape == (), "case", "one case", shown=f"batch shape {case.batch_shape}")
    found, gaps, late = (np.asarray(each) for each in _measure(case))
    is_clear = found & (gaps > 0.0)
    later = float(np.min(late, initial=np.inf, where=is_clear))
    return Prospects(poses=int(found.sum()), clear=int(is_clear.sum()), later=later)


@jax.jit
def _measure(case: BlockCase) -> tuple[Array, Array, Array]:
    flight = flight_of(case)
    poses = end_poses(case, flight, _POINTS, _PIECES)
    settings = case.rates, case.limits.velocity, case.limits.acceleration, case.ends_at_rest
    away = poses.angles - case.angles[None]
    least = jax.vmap(lambda away: jnp.max(least_times(away, *settings)[0]))(away)
    late = case.delay + least - poses.time
    return poses.is_found, case.clearances(poses.angles), late
