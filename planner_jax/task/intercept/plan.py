"""Plans of interceptions: the class, and functions that make a plan and set its status."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.core.protocol import Status, is_solved, status_of
from planner_jax.robot.car import CarPlan
from planner_jax.robot.car_motion import motion
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.problem import bounds, terms
from planner_jax.task.intercept.problem.clearance import clearance, is_blocked


@struct.dataclass
class InterceptPlan(CarPlan):
    """A car's plan up to the meeting with its target, or a batch: each leaf has a leading axis.

    Attributes:
        meeting: (2,) [m], expected position of the target at the end, relative to `origin`.
    """

    meeting: Array


def make_plan(
    case: InterceptCase,
    time: Array,
    speed: Array,
    curvature: Array,
    *,
    samples: int,
    points: int,
    steps: Array,
) -> InterceptPlan:
    """Make a plan from speed and curvature at knots, and check it against every limit of the case.

    The cost of the plan is its discomfort [m^2/s^3], as `terms.limit_terms` defines it. It extends
    the integral of the squared acceleration of [Qu2022, eq. 8a].
    Speed [m/s] and curvature [1/m] are the values at K + 1 equally spaced knots from time 0 to
    `time` () [s]. On each piece between two knots the distance from obstacles is checked at
    `samples` positions and, by a bound, between them, and the lateral acceleration at `points`
    positions. `steps` () int32 is the number of iterations that the plan reports.
    """
    drive = motion(case.start, time, speed, curvature, samples)
    weights = terms.Weights()
    _, violation, discomfort = terms.limit_terms(case, time, speed, curvature, weights, points)
    _, missed = terms.meeting_terms(case, drive, time, weights)
    too_close = -jnp.min(clearance(case, drive)) / case.body.width
    worst = jnp.maximum(jnp.maximum(violation, missed), too_close)
    return InterceptPlan(
        cost=discomfort,
        violation=worst,
        iterations=steps,
        status=status_of(discomfort, worst, True),
        start=case.start,
        time=time,
        speed=speed,
        curvature=curvature,
        origin=case.origin,
        meeting=case.target.at(time).pos,
    )


def make_straight_plan(case: InterceptCase, pieces: int) -> InterceptPlan:
    """Make a plan with the status INFEASIBLE that keeps the case's initial speed and curvature."""
    return InterceptPlan(
        cost=jnp.zeros_like(case.time),
        violation=jnp.full_like(case.time, jnp.inf),
        iterations=jnp.zeros((), jnp.int32),
        status=jnp.full((), Status.INFEASIBLE, jnp.int32),
        start=case.start,
        time=case.time,
        speed=jnp.full(pieces + 1, case.speed),
        curvature=jnp.full(pieces + 1, case.curvature),
        origin=case.origin,
        meeting=case.target.at(case.time).pos,
    )


def explain(
    case: InterceptCase, reason: Array, plan: InterceptPlan, *, is_time_free: bool = False
) -> InterceptPlan:
    """Return a plan; if it is unsolved, its status is replaced by the reason why it is unsolved.

    The reason is NON_FINITE if a number of the case is NaN. Else it is BLOCKED if the car overlaps
    an obstacle or is off the map at the start, or if the meeting time is fixed and the target is
    then too close to an obstacle or off the map. Else it is TOO_FAR if the car cannot drive far
    enough until any allowed meeting time. Else it is the status `reason` () int32. `is_time_free`
    is true if the planner may choose an earlier meeting time than the time of the case.
    """
    is_too_far = bounds.is_too_far(case, is_time_free=is_time_free)
    reason = jnp.where(is_too_far, Status.TOO_FAR, reason)
    is_start_blocked, is_goal_blocked = is_blocked(case)
    blocked = is_start_blocked if is_time_free else is_start_blocked | is_goal_blocked
    reason = jnp.where(blocked, Status.BLOCKED, reason)
    floats = [leaf for leaf in jax.tree.leaves(case) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    is_finite = jnp.all(jnp.stack([jnp.all(~jnp.isnan(leaf)) for leaf in floats]))
    reason = jnp.where(is_finite, reason, Status.NON_FINITE)
    keeps = (is_solved(plan.status) | (plan.status == Status.NON_FINITE)) & is_finite
    return dataclasses.replace(plan, status=jnp.where(keeps, plan.status, reason).astype(jnp.int32))
