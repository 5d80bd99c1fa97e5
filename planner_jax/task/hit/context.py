"""Functions that all hit planners use: ball's path, limits at the impact, balls out of reach."""

import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.ball.flight_table import FlightTable, longest_flight, tabulate_flight
from planner_jax.robot.quadrotor import ALLOWED, beyond_reach, greatest_speed
from planner_jax.task.hit.case import HitCase
from planner_jax.task.hit.plan import Stroke

_SLACK = 0.02  # [m], in `is_too_far`, far more than the errors of contacts that the referee accepts


@struct.dataclass
class HitContext:
    """One case with its ball's predicted path and landing time, computed before the search."""

    case: HitCase
    path: FlightTable  # states of the incoming ball, from time 0 until after it lands
    landing_time: Array  # () [s], at which the incoming ball would land without a hit


def prepare_hit(case: HitCase) -> HitContext:
    """Tabulate the incoming ball's flight, and estimate its landing time.

    The table extends until the ball has landed, by `longest_flight`.
    """
    if case.lift is None:
        horizon = longest_flight(case.ball, case.drag, case.gravity)
        path = tabulate_flight(case.ball, horizon, case.drag, case.gravity)
    else:
        from planner_jax.task.hit.spin import predict_spin

        path = predict_spin(case)
    node = jnp.sum(path.pos[1:, 2] > 0.0)  # the last node above the ground, if any
    # From there on a constant acceleration is assumed.
    height, fall = jnp.maximum(path.pos[node, 2], 0.0), -path.vel[node, 2]
    squared = fall * fall - 2.0 * height * path.acc[node, 2]
    remaining = 2.0 * height / jnp.maximum(fall + jnp.sqrt(jnp.maximum(squared, 0.0)), 0.1)
    landing = path.times[node] + remaining
    return HitContext(case=case, path=path, landing_time=lax.stop_gradient(landing))


@struct.dataclass
class Impact:
    """The impact of ball and racket, with the quadrotor's state and the returned ball's apex."""

    stroke: Stroke  # impact, and the ball's flight to the landing point
    tail_state: Array  # (4, 3) position, velocity, acceleration, jerk of the quadrotor at impact
    apex: Array  # () [m], greatest height of the returned ball
    is_returned: Array | bool = True  # () bool, whether the ball is met and reaches the target


def is_too_far(context: HitContext) -> Array:
    """Return true only if the quadrotor provably cannot hit the ball at any time, () bool.

    At an impact the distance between quadrotor and ball is the racket's height, the quadrotor is
    above its least height, and the ball is between the ground and the greatest allowed apex. These
    conditions are tested at the times of the ball's table, with a margin for the distances that
    ball and quadrotor can move in half a time step. If a number is not finite, the result is false.
    """
    case, path = context.case, context.path
    limits, ball = case.limits, case.ball
    pos, vel, times = path.pos, path.vel, path.times
    # Half of the longer interval next to each time; the intervals become longer.
    half_step = 0.5 * jnp.concatenate([times[1:] - times[:-1], times[-1:] - times[-2:-1]])
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
