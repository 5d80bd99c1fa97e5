"""What the published baselines of paper 002 share: the stroke, and how far a plan is off."""

import jax.numpy as jnp
from jax import Array

from planner_jax.ball.flight import BallState, drag_free_apex, gravity_vector
from planner_jax.cost.contact import apex_excess, hitting_speed_excess
from planner_jax.cost.limits import relative
from planner_jax.task.hit.exact import Impact
from planner_jax.task.hit.plan import HitPlan, Stroke
from planner_jax.task.hit.scenario import HitScenario
from planner_jax.trajectory.polynomial import PiecewisePolynomial


def make_impact(
    time: Array,
    flight_time: Array,
    ball: BallState,
    after: Array,
    racket_vel: Array,
    thrust: Array,
    scenario: HitScenario,
) -> Impact:
    """The impact of a ball on a quadrotor whose racket faces along its thrust.

    Args:
        time: () [s], of the impact.
        flight_time: () [s], from the impact to the landing.
        ball: just before the impact.
        after: (3,) [m/s], velocity of the ball just after it.
        racket_vel: (3,) [m/s], of the quadrotor.
        thrust: (3,) [m/s^2], per unit mass; not zero.
        scenario: for racket height and gravity.

    Returns:
        The impact, the racket's centre at the ball and the quadrotor without jerk.
    """
    normal = thrust / jnp.sqrt(jnp.maximum(jnp.sum(thrust**2), 1e-6))
    tail_state = jnp.stack(
        [
            ball.pos - scenario.racket_height * normal,
            racket_vel,
            thrust + gravity_vector(scenario.gravity),
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
    apex = drag_free_apex(BallState(ball.pos, after), scenario.gravity)
    return Impact(stroke=stroke, tail_state=tail_state, apex=apex)


def largest_violation(along: Array, impact: Impact, scenario: HitScenario) -> Array:
    """Largest excess over any limit, that of the ground in metres and all others relative, ().

    Args:
        along: (4, N) from `planner_jax.cost.limits.motion_excess`.
        impact: with the apex and the hitting speeds.
        scenario: for the limits.
    """
    limits = scenario.hit_limits
    apex = apex_excess(impact.apex, limits.min_apex, limits.max_apex)
    speed = hitting_speed_excess(impact.tail_state[1], limits.hitting_speed)
    squared = jnp.concatenate([jnp.max(along[:3], axis=1), speed])
    plain = jnp.concatenate([jnp.max(along[3:], axis=1), apex])
    return jnp.maximum(jnp.max(relative(squared)), jnp.max(plain))


def undecided_plan(
    trajectory: PiecewisePolynomial, impact: Impact, cost: Array, violation: Array
) -> HitPlan:
    """A plan whose iterations and status the solver is still to fill in, and its cost anew."""
    return HitPlan(
        trajectory=trajectory,
        stroke=impact.stroke,
        cost=cost,
        violation=violation,
        iterations=jnp.zeros((), jnp.int32),
        status=jnp.zeros((), jnp.int32),
    )
