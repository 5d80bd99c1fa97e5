"""The state of a trial of rallies; it has a fixed size for any number of hits."""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.perception.drag import RlsState
from planner_jax.sims.robot import Physics
from planner_jax.sims.sensing import Estimate
from planner_jax.task.rally.plan import RallyPlan


@struct.dataclass
class Bounce:
    """The last impact as the robot felt it."""

    time: Array  # () [s]; -inf before the first impact
    tool_vel: Array  # (3,) [m/s], velocity of the racket at the ball
    normal: Array  # (3,), unit normal of the racket
    ball_vel: Array  # (3,) [m/s], estimated velocity of the ball before the impact
    is_due: Array  # () bool, whether the estimate of the ball belongs to a time before the impact
    is_learned: Array  # () bool, whether the restitution was estimated from this impact


@struct.dataclass
class Passage:
    """The ball's last passage through the racket's plane, which was a hit or a miss."""

    offset: Array  # () [m], distance of the ball from the racket's centre in the racket's plane
    tracking: Array  # () [m], distance of the robot from its plan then
    late: Array  # () [s], time of that passage after the planned time
    violation: Array  # (), greatest relative excess of the plan over a limit
    restitution: Array  # (), error of the estimated restitution
    drag: Array  # (), relative error of the estimated drag


@struct.dataclass
class Trial:
    """The variables of one trial of N robots: physics, estimates, plans and scores."""

    physics: Physics  # leaves (N, ...), of each robot's world
    shown: Array  # (L, 3) [m], true positions of the ball that are still to be observed
    estimate: Estimate  # of the ball, one latency ago
    bounce: Bounce
    restitution: RlsState  # estimate of 1 + (coefficient of restitution)
    plan: RallyPlan  # leaves (N, ...), of each robot
    began: Array  # (N,) [s], start times of the plans
    planned: Array  # (N,) int32, number of each robot's hits before its plan's start
    hits: Array  # () int32, number of hits of all robots so far
    lost: Array  # () bool, whether the trial has ended by a rule of `RallyPilot.course`
    aimed: Array  # () int32, number of hits so far whose ball had to come to the circle
    inside: Array  # () int32, number of these balls that were met in the circle
    last: Passage
    worst_offset: Array  # () [m], greatest offset of a hit so far
    sum_offset: Array  # () [m], sum of the offsets of all hits
    worst_tracking: Array  # () [m], greatest distance from the plan so far
    squared_tracking: Array  # () [m^2 s], integral of the squared distance
    tracked: Array  # () [s], duration over which the squared distance is integrated
    time: Array  # () [s]
    key: Array


@struct.dataclass
class Frames:
    """The states of B trials at O observations in each of P planning periods."""

    qpos: Array  # (P, B, O, N, R + 3), joint positions of each robot and the ball
    wanted: Array  # (P, B, O, N, 3) [m], planned positions of the robots


def pick(condition: Array, new: PyTree, old: PyTree) -> PyTree:
    """Return `new` where a condition () or (N,) holds, else `old`, for leaves (...) or (N, ...)."""
    shaped = lambda leaf: condition.reshape(condition.shape + (1,) * (leaf.ndim - condition.ndim))  # noqa: E731
    return jax.tree.map(lambda a, b: jnp.where(shaped(a), a, b), new, old)
