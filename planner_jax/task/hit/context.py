"""Functions that all hit planners share: the ball's table, the impact, a bound on the reach."""

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

_SLACK = 0.02  # [m], far more than the contact error that the referee accepts


@struct.dataclass
class HitContext:
    """One case with the quantities that every evaluation of the objective reads."""

    case: HitCase
    path: PathTable  # of the incoming ball
    landing_time: Array  # () [s], of the ball without a hit


def prepare_hit(case: HitCase, num_nodes: int) -> HitContext:
    """Tabulate the incoming ball's flight, up to 1.1 times the duration of its drag-free fall."""
    fall, _ = drag_free_fall_time(case.ball, jnp.zeros_like(case.drag), case.gravity)
    horizon = lax.stop_gradient(1.1 * fall)
    path = predict_path(case.ball, horizon, case.drag, case.gravity, num_nodes=num_nodes)
    node = jnp.maximum(jnp.sum(path.pos[1:, 2] > 0.0), 1)
    # Below the last node above the ground the ball is taken to sink at the speed of that node.
    sinking = jnp.maximum(-path.vel[node, 2], 0.1)
    landing = (node - 1).astype(sinking.dtype) * path.resolution + path.pos[node, 2] / sinking
    return HitContext(case=case, path=path, landing_time=lax.stop_gradient(landing))


@struct.dataclass
class Impact:
    """A stroke with the state of the quadrotor at the impact."""

    stroke: Stroke
    tail_state: Array  # (4, 3) position to jerk of the quadrotor at the impact
    apex: Array  # () [m], of the returned ball


def is_too_far(context: HitContext) -> Array:
    """Return whether a bound proves that the quadrotor cannot reach the ball, () bool.

    At an impact the quadrotor is the racket's height away from the ball and above its least
    height, and the ball is above the ground and not above the greatest apex. The bound is evaluated
    at the nodes of the ball's table. An impact is within half a step of a node, so the bound adds
    the distances that ball and quadrotor move in half a step.

    False proves nothing. The result is false where a number is not finite.
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
    # At the end of the table the ball must be below every possible impact, and sinking.
    is_down = (pos[-1, 2] < lowest) & (vel[-1, 2] < 0.0)
    return jnp.all(apart > moved) & is_down


def apex_excess(apex: Array, min_apex: Array, max_apex: Array) -> Array:
    """Return 1 - H / H_min and H / H_max - 1 of the apex H [Yu2023bat, eq. 21], shape (2,)."""
    return jnp.stack([1.0 - apex * reciprocal(min_apex), apex * reciprocal(max_apex) - 1.0])


def hitting_speed_excess(vel: Array, limit: Array) -> Array:
    """Return v_j^2 / v_max,j^2 - 1 for each world axis j [Yu2023bat, eq. 24], shape (3,)."""
    return (vel * reciprocal(limit)) ** 2 - 1.0
