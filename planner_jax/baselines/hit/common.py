"""Shared parts of the planners of hits of [Yu2023bat]: impact, and largest excess over a limit."""

import jax.numpy as jnp
from jax import Array

from planner_jax.ball.flight import BallState, drag_free_apex, gravity_vector
from planner_jax.core.errors import ArgumentError
from planner_jax.cost.quadrotor import relative
from planner_jax.penalties.flight import (
    acceleration_excess,
    body_rate_excess,
    ground_excess,
    speed_excess,
)
from planner_jax.penalties.hits import apex_excess, hitting_speed_excess
from planner_jax.robot.quadrotor import QuadrotorLimits
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.context import Impact
from planner_jax.task.hit.plan import Stroke
from planner_jax.trajectory.polynomial import Motion


def make_impact(
    time: Array,
    flight_time: Array,
    ball: BallState,
    after: Array,
    racket_vel: Array,
    thrust: Array,
    case: HitCase,
) -> Impact:
    """Return the impact of a ball on a quadrotor whose racket faces along its thrust.

    Args:
        time: () [s], time of the impact.
        flight_time: () [s], duration of the ball's flight from the impact to the landing.
        ball: state of the ball just before the impact.
        after: (3,) [m/s], velocity of the ball just after the impact.
        racket_vel: (3,) [m/s], velocity of the quadrotor at the impact.
        thrust: (3,) [m/s^2], thrust per unit mass; not zero.
        case: the case, for the height of the racket and gravity.

    Returns:
        The impact, with the racket's centre at the ball and zero jerk of the quadrotor.
    """
    if case.lift is not None:
        raise ArgumentError("spin", "left out, except for the planner exact", shown="a spin")
    normal = thrust / jnp.sqrt(jnp.maximum(jnp.sum(thrust**2), 1e-6))
    tail_state = jnp.stack(
        [
            ball.pos - case.racket_height * normal,
            racket_vel,
            thrust + gravity_vector(case.gravity),
            jnp.zeros_like(thrust),
        ]
    )
    stroke = Stroke(
        time=time,
        ball_pos=ball.pos,
        ball_vel=ball.vel,
        ball_vel_after=after,
        normal=normal,
        flight_time=flight_time,
    )
    apex = drag_free_apex(BallState(ball.pos, after), case.gravity)
    return Impact(stroke=stroke, tail_state=tail_state, apex=apex)


def largest_violation(along: Array, impact: Impact, case: HitCase) -> Array:
    """Return the largest relative excess () over any limit; a lack of height counts in metres.

    Args:
        along: (4, N) excess at N samples of the trajectory, from `motion_excess`.
        impact: the impact, for the returned ball's apex and the quadrotor's velocity.
        case: the case, for its limits.
    """
    limits = case.hit_limits
    apex = apex_excess(impact.apex, limits.min_apex, limits.max_apex)
    speed = hitting_speed_excess(impact.tail_state[1], limits.hitting_speed)
    squared = jnp.concatenate([jnp.max(along[:3], axis=1), speed])
    plain = jnp.concatenate([jnp.max(along[3:], axis=1), apex])
    return jnp.maximum(jnp.max(relative(squared)), jnp.max(plain))


def motion_excess(motion: Motion, gravity: Array, limits: QuadrotorLimits) -> tuple[Array, ...]:
    """Return the excess (N,) of N samples over each of four limits [Yu2023bat, eq. 18a].

    An excess is (value / limit)^2 - 1 for speed, acceleration and body rate, z_min - z for height.
    It is -1 for acceleration without a limit.
    """
    bound, free = limits.acceleration, 0.0 * motion.height - 1.0
    return (
        speed_excess(motion.vel, limits.speed),
        free if bound is None else acceleration_excess(motion.acc, bound),
        body_rate_excess(motion.acc, motion.jerk, gravity, limits.body_rate),
        ground_excess(motion.height, limits.min_height),
    )
