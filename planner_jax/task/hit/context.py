"""One hit as every planner of the task sees it: the ball's path, an impact, and a bound on both."""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.ball.flight import drag_free_fall_time
from planner_jax.ball.prediction import PathTable, predict_path
from planner_jax.core.arithmetic import reciprocal
from planner_jax.robot.quadrotor import ALLOWED, beyond_reach, greatest_speed
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.plan import Stroke

_SLACK = 0.02  # [m], far more than a plan that the referee accepts may be off its ball


@struct.dataclass
class HitContext:
    """One case with what every evaluation reuses."""

    case: HitCase
    path: PathTable  # of the incoming ball
    landing_time: Array  # () [s], when the ball would land if nobody hit it


def prepare_hit(case: HitCase, num_nodes: int) -> HitContext:
    """Integrate the incoming ball once; shared by all hit planners.

    The table's horizon follows the drag-free fall, which drag changes by a few per cent.
    """
    fall, _ = drag_free_fall_time(case.ball, jnp.zeros_like(case.drag), case.gravity)
    horizon = lax.stop_gradient(1.1 * fall)
    path = predict_path(case.ball, horizon, case.drag, case.gravity, num_nodes=num_nodes)
    node = jnp.maximum(jnp.sum(path.pos[1:, 2] > 0.0), 1)
    # From the last node above the ground, down at that node's speed.
    sinking = jnp.maximum(-path.vel[node, 2], 0.1)
    landing = (node - 1) * path.resolution + path.pos[node, 2] / sinking
    return HitContext(case=case, path=path, landing_time=lax.stop_gradient(landing))


@struct.dataclass
class Impact:
    """A stroke with the quadrotor states at both ends of its trajectory."""

    stroke: Stroke
    tail_state: Array  # (4, 3) of the quadrotor at the impact
    apex: Array  # () [m], of the returned ball


def is_too_far(context: HitContext) -> Array:
    """Return whether the quadrotor can be near the ball at no time of its flight, () bool.

    At an impact the quadrotor is the racket's height away from the ball, above its least height,
    and the ball above the ground and not above the greatest apex. Looked at are the nodes of the
    ball's table: an impact is within half a step of one of them, in which ball and quadrotor move
    by what is added to the distance.

    False does not say that there is a plan. A number that is not finite makes it false.
    """
    case, path = context.case, context.path
    limits, ball = case.limits, case.ball
    pos, vel = path.pos[1:-1], path.vel[1:-1]
    half_step = 0.5 * path.resolution
    times = path.resolution * jnp.asarray(np.arange(pos.shape[0]), pos.dtype)
    # The ball is fastest at the ground if drag takes nothing away.
    fastest_squared = jnp.sum(ball.vel * ball.vel) + 2.0 * case.gravity * jnp.abs(ball.pos[2])
    bend = 0.5 * (case.gravity + case.drag * fastest_squared) * half_step**2
    speed = jnp.sqrt(jnp.sum(vel * vel, axis=1))
    moved = (speed + greatest_speed(case.head_state, limits)) * half_step + bend
    arm = jnp.abs(case.racket_height) + _SLACK
    far = beyond_reach(pos, times, case.head_state, limits, case.gravity)
    lowest = jnp.maximum(limits.min_height - arm, 0.0)
    low = lowest - pos[:, 2] - _SLACK
    high = pos[:, 2] - ALLOWED * case.hit_limits.max_apex - _SLACK
    apart = jnp.maximum(far - arm, jnp.maximum(low, high))
    # A ball that is still up at the end of the table goes on behind it.
    is_down = (pos[-1, 2] < lowest) & (vel[-1, 2] < 0.0)
    return jnp.all(apart > moved) & is_down


def apex_excess(apex: Array, min_apex: Array, max_apex: Array) -> Array:
    """Return the relative excess over the floor and roof of the returned ball [Yu2023bat, eq. 21].

    Returns:
        (2,) (H_min - H) / H_min and (H - H_max) / H_max.
    """
    return jnp.stack([1.0 - apex * reciprocal(min_apex), apex * reciprocal(max_apex) - 1.0])


def hitting_speed_excess(vel: Array, limit: Array) -> Array:
    """Return v_j^2 / v_max,j^2 - 1 on each world axis [Yu2023bat, eq. 24], shape (3,)."""
    return (vel * reciprocal(limit)) ** 2 - 1.0
