"""Whether a ball can be hit at all: a bound that no plan can beat, from what is known already."""

import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.robot.quadrotor_reach import ALLOWED, beyond_reach, greatest_speed
from planner_jax.task.hit.context import HitContext

_SLACK = 0.02  # [m], far more than a plan that passes the referee may be off its ball


def is_too_far(context: HitContext) -> Array:
    """Whether the quadrotor can be near the ball at no time of its flight, () bool.

    At an impact the quadrotor is the racket's height away from the ball, above its least height,
    and the ball above the ground and not above the greatest apex. Looked at are the nodes of the
    ball's table: an impact is within half a step of one of them, in which ball and quadrotor move
    by what is added to the distance.

    False does not say that there is a plan. A number that is not finite makes it false.

    Args:
        context: of one case.
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
