"""What every planner that works in compiled programs says of its plan in the end."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from planner_jax.core.protocol import Status, is_solved, status_of
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.motion import motion
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.terms import (
    Weights,
    clearance,
    is_blocked,
    limit_terms,
    meeting_terms,
)

GRAZING = 5e-3  # [m], from obstacles, so that nothing is touched between two looks


def checked_plan(
    case: InterceptCase,
    time: Array,
    speed: Array,
    curvature: Array,
    *,
    samples: int,
    places: int,
    steps: Array,
) -> InterceptPlan:
    """The plan of knots, held against every limit of its case.

    Its cost is the integral of the squared acceleration [m^2/s^3] (paper 003, eq. 8a).

    Args:
        case: one case.
        time: () [s], when it ends, at the target.
        speed: (K + 1,) [m/s], at equal knots, the first as the case has it.
        curvature: (K + 1,) [1/m], likewise.
        samples: of every piece, where obstacles are looked at, static.
        places: in every piece where the lateral acceleration is looked at, static.
        steps: () int32, its iterations.
    """
    way = motion(case.start, time, speed, curvature, samples)
    _, violation = limit_terms(case, time, speed, curvature, Weights(), places)
    _, missed = meeting_terms(case, way, time, Weights())
    bumped = (GRAZING - jnp.min(clearance(case, way))) / case.body.width
    worst = jnp.maximum(jnp.maximum(violation, missed), bumped)
    effort = jnp.sum((speed[1:] - speed[:-1]) ** 2) * (speed.shape[0] - 1) / time
    return InterceptPlan(
        cost=effort,
        violation=worst,
        iterations=steps,
        status=status_of(effort, worst, True),
        start=case.start,
        time=time,
        speed=speed,
        curvature=curvature,
        meeting=case.target.at(time).pos,
    )


def straight_on(case: InterceptCase, pieces: int) -> InterceptPlan:
    """A plan that goes straight on, for want of a better one."""
    return InterceptPlan(
        cost=jnp.zeros_like(case.time),
        violation=jnp.full_like(case.time, jnp.inf),
        iterations=jnp.zeros((), jnp.int32),
        status=jnp.full((), Status.INFEASIBLE, jnp.int32),
        start=case.start,
        time=case.time,
        speed=jnp.full(pieces + 1, case.speed),
        curvature=jnp.full(pieces + 1, case.curvature),
        meeting=case.target.at(case.time).pos,
    )


def explained(
    case: InterceptCase, reason: Array, plan: InterceptPlan, *, is_time_free: bool = False
) -> InterceptPlan:
    """The plan with a status that says why there is none.

    Args:
        case: one case.
        reason: () int32, the status of an unsolved plan if nothing is wrong with its case.
        plan: of the case.
        is_time_free: whether the target may be met before the case's time, static.
    """
    here, there = is_blocked(case)
    blocked = here if is_time_free else here | there
    reason = jnp.where(blocked, Status.BLOCKED, reason)
    floats = [leaf for leaf in jax.tree.leaves(case) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    is_finite = jnp.all(jnp.stack([jnp.all(~jnp.isnan(leaf)) for leaf in floats]))
    reason = jnp.where(is_finite, reason, Status.NON_FINITE)
    keeps = (is_solved(plan.status) | (plan.status == Status.NON_FINITE)) & is_finite
    status = jnp.where(keeps, plan.status, reason).astype(jnp.int32)
    return dataclasses.replace(plan, status=status)
