"""Functions that all hit planners use: ball's path, limits at the impact, balls out of reach."""

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

_SHORTEST = 0.01  # [s], least duration of the ball's table; a ball on the ground lands at once
_SLACK = 0.02  # [m], in `is_too_far`, far more than the errors of contacts that the referee accepts


@struct.dataclass
class HitContext:
    """One case with its ball's predicted path and landing time, computed before the search."""

    case: HitCase
    path: PathTable  # positions and velocities of the incoming ball at equally spaced times
    landing_time: Array  # () [s], at which the incoming ball would land without a hit


def prepare_hit(case: HitCase, num_nodes: int) -> HitContext:
    """Tabulate the incoming ball's flight at `num_nodes` times, and estimate its landing time.

    The table extends to 1.1 times the time at which a ball without drag would land.
    """
    fall, _ = drag_free_fall_time(case.ball, jnp.zeros_like(case.drag), case.gravity)
    horizon = lax.stop_gradient(jnp.maximum(1.1 * fall, _SHORTEST))
    if case.lift is None:
        path = predict_path(case.ball, horizon, case.drag, case.gravity, num_nodes=num_nodes)
    else:
        from planner_jax.task.hit.spin import predict_spin

        path = predict_spin(case, num_nodes)
    node = jnp.maximum(jnp.sum(path.pos[1:, 2] > 0.0), 1)
    # Landing time: after the last tabulated time at which the ball is above the ground, its rate
    # of descent is assumed to be constant.
    sinking = jnp.maximum(-path.vel[node, 2], 0.1)
    landing = (node - 1).astype(sinking.dtype) * path.resolution + path.pos[node, 2] / sinking
    return HitContext(case=case, path=path, landing_time=lax.stop_gradient(landing))


@struct.dataclass
class Impact:
    """The impact of ball and racket, with the quadrotor's state and the returned ball's apex."""

    stroke: Stroke  # impact, and the ball's flight to the landing point
    tail_state: Array  # (4, 3) position, velocity, acceleration, jerk of the quadrotor at impact
    apex: Array  # () [m], greatest height of the returned ball


def is_too_far(context: HitContext) -> Array:
    """Return true only if the quadrotor provably cannot hit the ball at any time, () bool.

    At an impact the distance between quadrotor and ball is the racket's height, the quadrotor is
    above its least height, and the ball is between the ground and the greatest allowed apex. These
    conditions are tested at the times of the ball's table, with a margin for the distances that
    ball and quadrotor can move in half a time step. If a number is not finite, the result is false.
    """
    case, path = context.case, context.path
    limits, ball = case.limits, case.ball
    pos, vel = path.pos[1:-1], path.vel[1:-1]
    half_step = 0.5 * path.resolution
    times = path.resolution * jnp.asarray(np.arange(pos.shape[0]), pos.dtype)
    # A bound on the ball's squared speed: without drag the ball would be fastest at the ground.
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
    # After the last time of the ball's tabulated path an impact is impossible if the ball is then
    # sinking and below the least height of an impact.
    is_down = (pos[-1, 2] < lowest) & (vel[-1, 2] < 0.0)
    return jnp.all(apart > moved) & is_down


def apex_excess(apex: Array, min_apex: Array, max_apex: Array) -> Array:
    """Return relative excesses 1 - H / H_min, H / H_max - 1 of the apex H [Yu2023bat, eq. 21]."""
    return jnp.stack([1.0 - apex * reciprocal(min_apex), apex * reciprocal(max_apex) - 1.0])


def hitting_speed_excess(vel: Array, limit: Array) -> Array:
    """Return v_j^2 / v_max,j^2 - 1, (3,), of velocity v and limit v_max [Yu2023bat, eq. 24a]."""
    return (vel * reciprocal(limit)) ** 2 - 1.0
