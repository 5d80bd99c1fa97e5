"""Reasons why an arm does not block a ball: no pose, no clear pose, or no clear pose in time."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.checks import require_kind
from planner_jax.core.choices import require
from planner_jax.robot.arm_dynamics import USED
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.end_poses import end_poses, flight_of
from planner_jax.task.block.motion import least_times

_POINTS, _PIECES = 192, 10  # number of points of the ball's path with poses; see `end_poses`


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
    # Greatest ratio of a joint's torque to its limit, in the straight motion to a clear pose in
    # time that needs the least. 0 without limits of torque, infinite if no clear pose is in time.
    torque: float = 0.0

    def sentence(self) -> str:
        """Describe why the ball cannot be blocked, or that a search for a motion may succeed."""
        if not self.poses:
            return "the shield cannot get to the ball's path between the two boxes"
        if not self.clear:
            return f"the arm touches something in all {self.poses} poses that meet the ball"
        if self.later > 0.0:
            return f"the ball is too early: the arm is ready {self.later:.3f} s after it"
        if self.torque > 1.0:
            return (
                "the motors may be too weak: straight motions to clear poses in time need at least "
                f"{self.torque:.0%} of a joint's greatest torque"
            )
        return (
            f"{self.clear} of {self.poses} poses that meet the ball are clear, and one is reached "
            f"{-self.later:.3f} s early if nothing is in the way"
        )


def prospects(case: BlockCase) -> Prospects:
    """Return whether an arm's poses meet the ball, are clear and in time, and the torques.

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
    found, gaps, late, torque = (np.asarray(each) for each in _measure(case))
    is_clear = found & (gaps > 0.0)
    later = float(np.min(late, initial=np.inf, where=is_clear))
    torque = float(np.min(torque, initial=np.inf, where=is_clear & (late <= 0.0)))
    return Prospects(int(found.sum()), int(is_clear.sum()), later, torque)


@jax.jit
def _measure(case: BlockCase) -> tuple[Array, Array, Array, Array]:
    flight = flight_of(case)
    poses = end_poses(case, flight, _POINTS, _PIECES)
    settings = case.rates, case.limits.velocity, case.limits.acceleration, case.ends_at_rest
    away = poses.angles - case.angles[None]
    least = jax.vmap(lambda away: jnp.max(least_times(away, *settings)[0]))(away)
    late = case.delay + least - poses.time
    torque = jnp.zeros_like(late)
    if case.limits.torque is not None:
        online = OnlineBlock(pieces=_PIECES)
        points = jax.vmap(lambda k: online.encode_straight(case, poses, k))(jnp.arange(len(late)))
        excess = jax.vmap(lambda point: online.torque_excess(case, point))(points)
        torque = USED * (1.0 + excess)
    return poses.is_found, case.clearances(poses.angles), late, torque
