"""Checks of a motion against every limit of a block, and the plan that results."""

import dataclasses
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.protocol import FEASIBILITY_TOLERANCE, Status, is_solved, status_of
from planner_jax.robot import arm_dynamics, arm_motion
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.problem import terms
from planner_jax.task.block.problem.flight import Flight
from planner_jax.trajectory.polynomial import PiecewisePolynomial

if TYPE_CHECKING:
    from planner_jax.task.block.default_planner import OnlineBlock

_TORQUES = 24  # number of times, besides the knots of a motion, at which torques are computed


def motion_of(planner: "OnlineBlock", case: BlockCase, point: Array) -> PiecewisePolynomial:
    """Return the motion of the unknowns `point`, which are joint rates and time of contact."""
    steps, first, duration = planner.decode(case, point)
    return arm_motion.polynomial(case.angles, first, steps, duration)


def torque_excess(planner: "OnlineBlock", case: BlockCase, point: Array) -> Array:
    """Return the greatest relative excess () of a torque over its limit, less a reserve."""
    of_case, path = (case.arm, case.limits, case.gravity), motion_of(planner, case, point)
    return arm_dynamics.measure_torques(*of_case, path, _TORQUES)[0]


def combine_excess(joints: Array, contact: Array, too_near: Array) -> Array:
    """Return the violation () of a plan by relative excesses, and a missing distance [m]."""
    return jnp.maximum(jnp.maximum(joints, contact), 100.0 * too_near)


def margin_from(planner: "OnlineBlock", gap: Array) -> Array:
    """Return the margin () [m] of motions that start at a distance () [m] from other bodies."""
    return jnp.where(gap < planner.margin, 0.5 * jnp.maximum(gap, 0.0), planner.margin)


def checked_shares(planner: "OnlineBlock") -> tuple[float, ...]:
    """Return the samples of a motion that are checked, as fractions of the duration.

    They are the start and all samples except the first after it: 96 by default. A GPU runs
    threads in groups of 32, and takes a third longer for 97 samples.
    """
    return (0.0, *(np.arange(min(2, planner.checked), planner.checked + 1) / planner.checked))


def make_plan(
    planner: "OnlineBlock",
    case: BlockCase,
    flight: Flight,
    point: Array,
    steps: Array,
    angles: Array,
    gaps: Array,
) -> BlockPlan:
    """Return the plan of the unknowns `point`, which are joint rates and time of contact.

    Args:
        planner: the planner, whose limits and weights are used.
        case: the case.
        flight: times between which the ball must be met.
        point: unknowns of the motion.
        steps: () number of iterations that the plan reports.
        angles: (N, n) [rad], joint angles of the motion at `checked_shares`.
        gaps: (N,) [m], the least distances of bodies at these angles.
    """
    moves, first, duration = planner.decode(case, point)
    joints = terms.joint_terms(case, moves, first, duration, planner.weights, 1.0 - planner.slack)
    # A joint may exceed its position limit between two knots and turn back: check all samples.
    middle = 0.5 * (case.arm.upper + case.arm.lower)
    half = 0.5 * (case.arm.upper - case.arm.lower)
    beyond = jnp.max(jnp.abs(angles - middle[None]) / half[None]) - 1.0
    contact = terms.contact_terms(case, flight, angles[-1], point[-1], planner.weights)[2]
    joint_excess = jnp.maximum(joints.excess, beyond)
    if case.limits.torque is not None:
        joint_excess = jnp.maximum(joint_excess, torque_excess(planner, case, point))
    margin = margin_from(planner, gaps[0])
    excess = combine_excess(joint_excess, contact, margin - jnp.min(gaps[1:]))
    violation = jnp.where(point[-1] > case.delay, excess, jnp.inf)
    status = status_of(joints.load, violation, violation > FEASIBILITY_TOLERANCE)
    is_blocked = (gaps[0] < 0.0) & ~is_solved(status)  # the arm touches something at the start
    plan = BlockPlan(
        motion=arm_motion.polynomial(case.angles, first, moves, duration),
        contact_time=point[-1],
        cost=joints.load,
        violation=violation,
        iterations=jnp.asarray(steps, jnp.int32),
        status=jnp.where(is_blocked, Status.BLOCKED, status).astype(jnp.int32),
    )
    if not planner.brisk:
        return plan
    most = 1.0 - planner.slack
    rate, rise = most * case.limits.velocity, most * case.limits.acceleration
    path, pace = arm_motion.speed_up(plan.motion, rate, rise)
    if case.limits.torque is not None:
        of_case = case.arm, case.limits, case.gravity
        slower = arm_dynamics.measure_torques(*of_case, path, _TORQUES)[1]
        # The slow motion keeps the limits, also where the arm could not stand still.
        slower = jnp.minimum(slower, 1.0 / pace)
        path, pace = arm_dynamics.stretch(path, slower), pace * slower
    rests = is_solved(plan.status) & case.ends_at_rest & jnp.all(case.rates == 0.0)
    plan = dataclasses.replace(plan, cost=duration)
    quick = dataclasses.replace(plan, motion=path, cost=pace * duration)
    return jax.tree.map(lambda new, old: jnp.where(rests, new, old), quick, plan)
