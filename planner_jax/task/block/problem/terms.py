"""Terms of a block's cost, with derivatives: squared residuals of joints and contact."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.ball.flight import drag_free_flight
from planner_jax.robot.arm import (
    product,
    shield_inradius,
    shield_jacobian,
    shield_pose,
    shield_sides,
)
from planner_jax.robot.arm_motion import angles_at, step_weights
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.problem.end_poses import face_ball, frame_of
from planner_jax.task.block.problem.flight import Flight

_HIGHEST = lax.Precision.HIGHEST
_PLANE = 1e-3  # [m], greatest distance of the ball from the shield's plane at the contact
_SPARE = 0.95  # greatest planned fraction of the distance from the shield's middle to a side


@dataclasses.dataclass(frozen=True)
class Weights:
    """Weights of the residuals whose squares the search for an arm's motion minimises."""

    meeting: float = 100.0  # [1/m], of the ball's distances from the shield's plane and middle
    tilt: float = 30.0  # [1/rad], of the shield's tilt against the ball's path
    limits: float = 30.0  # of relative excesses over the joints' limits
    clearance: float = 100.0  # [1/m], of distances below the required distance from obstacles
    effort: float = 0.1  # of joint accelerations divided by their limits


class JointTerms(NamedTuple):
    """Cost of joint limits and accelerations, a sum of squared residuals r, with derivatives.

    J is the Jacobian of one joint's residuals by K + 1 variables: the joint's rates at the ends of
    K pieces of the motion, multiplied by the duration, and the time of contact.
    """

    cost: Array  # (), r . r, summed over the joints
    gradient: Array  # (n, K + 1), J^T r
    curvature: Array  # (n, K + 1, K + 1), J^T J
    excess: Array  # (), largest relative excess over a limit
    load: Array  # (), root mean square of accelerations divided by their limits


def joint_terms(
    case: BlockCase, steps: Array, first: Array, duration: Array, weights: Weights, most: float
) -> JointTerms:
    """Compute the cost of the joints' limits and accelerations, with its derivatives.

    The joint rates at the start are `first` (n,) [rad], and at the ends of K pieces `steps` (K, n)
    [rad], both multiplied by the motion's `duration` () [s]. Rates, accelerations and angles are
    penalised above `most` times their limits.
    """
    pieces, dtype = steps.shape[0], steps.dtype
    knots = tuple(np.arange(1, pieces + 1) / pieces)
    of_first, of_steps = (jnp.asarray(each, dtype) for each in step_weights(pieces, knots))
    rise = jnp.asarray(np.eye(pieces) - np.eye(pieces, k=-1), dtype)
    rates = steps / duration
    accelerations = (steps - jnp.concatenate([first[None], steps[:-1]])) * (pieces / duration**2)
    angles = angles_at(case.angles, first, steps, knots)
    middle = 0.5 * (case.arm.upper + case.arm.lower)
    half = 0.5 * (case.arm.upper - case.arm.lower)

    def row(
        value: Array, by_steps: Array, by_time: Array, slope: float | Array
    ) -> tuple[Array, Array]:
        slopes = jnp.concatenate([by_steps, by_time.T[:, :, None]], axis=2)
        return value.T, slopes * jnp.broadcast_to(slope, value.shape).T[:, :, None]

    def hinge(share: Array, by_steps: Array, by_time: Array) -> tuple[Array, Array]:
        over = weights.limits * jnp.maximum(jnp.abs(share) - most, 0.0)
        sign = weights.limits * jnp.sign(share) * (over > 0.0).astype(over.dtype)
        return row(over, by_steps, by_time, sign)

    of_rate = jnp.eye(pieces, dtype=dtype)[None] / (duration * case.limits.velocity[:, None, None])
    rate_shares = rates / case.limits.velocity[None]
    of_rise = rise[None] * (pieces / duration**2 / case.limits.acceleration[:, None, None])
    rise_shares = accelerations / case.limits.acceleration[None]
    of_start = jnp.zeros_like(rise_shares).at[0].set(first * pieces / duration**2)
    by_time = (-2.0 * rise_shares - of_start / case.limits.acceleration[None]) / duration
    angle_shares = (angles - middle[None]) / half[None]
    of_angle = of_steps[None] / half[:, None, None]
    effort = weights.effort
    parts = [
        hinge(rate_shares, of_rate, -rate_shares / duration),
        hinge(rise_shares, of_rise, by_time),
        hinge(angle_shares, of_angle, of_first[:, None] * case.rates[None] / half[None]),
        row(effort * rise_shares, of_rise, by_time, effort),
    ]
    values = jnp.concatenate([value for value, _ in parts], axis=1)
    slopes = jnp.concatenate([slope for _, slope in parts], axis=1)
    excess = [jnp.max(jnp.abs(each)) for each in (rate_shares, rise_shares, angle_shares)]
    return JointTerms(
        jnp.sum(values**2),
        jnp.einsum("irk,ir->ik", slopes, values, precision=lax.Precision.HIGHEST),
        jnp.einsum("irk,irl->ikl", slopes, slopes, precision=lax.Precision.HIGHEST),
        jnp.max(jnp.stack(excess)) - 1.0,
        jnp.sqrt(jnp.maximum(jnp.mean(rise_shares**2), 1e-12)),
    )


def lift_to_unknowns(
    lift: Array, drift: Array, grams: Array, pushes: Array, joints: JointTerms
) -> tuple[Array, Array]:
    """Return J^T r and J^T J, where J is the Jacobian of all residuals r by all unknowns.

    The unknowns are the rates of each of the n joints after K pieces of the motion, multiplied by
    its duration, and the time of contact.

    Args:
        lift: (W, K), derivatives of a joint's angle at W samples by the K unknowns of the joint.
        drift: (W, n), derivatives of the joint angles at the samples by the time of contact.
        grams: (W, n + 1, n + 1), J^T J of the residuals at each sample, here with the Jacobian J by
            the n joint angles and the time.
        pushes: (W, n + 1), J^T r of the residuals at each sample, with the same J.
        joints: terms of the joints' limits and accelerations.
    """
    num = drift.shape[1]
    grams_q, grams_t = grams[:, :num, :num], grams[:, :num, num]
    moved = jnp.einsum("wij,wj->wi", grams_q, drift, precision=_HIGHEST) + grams_t
    time_stiffness = jnp.sum(grams[:, num, num] + jnp.sum(drift * (moved + grams_t), axis=1))
    time_push = jnp.sum(pushes[:, num] + jnp.sum(drift * pushes[:, :num], axis=1))
    stiffness = jnp.einsum("wk,wl,wij->kilj", lift, lift, grams_q, precision=_HIGHEST)
    coupling = jnp.einsum("wk,wi->ki", lift, moved, precision=_HIGHEST)
    steps_push = jnp.einsum("wk,wi->ki", lift, pushes[:, :num], precision=_HIGHEST)
    each = jnp.eye(num, dtype=lift.dtype)
    of_each = joints.curvature[:, :-1, :-1]
    stiffness += jnp.einsum("ikl,ij->kilj", of_each, each, precision=_HIGHEST)
    coupling += joints.curvature[:, :-1, -1].T
    steps_push += joints.gradient[:, :-1].T
    time_push += jnp.sum(joints.gradient[:, -1])
    time_stiffness += jnp.sum(joints.curvature[:, -1, -1])
    size = num * lift.shape[1]
    curvature = jnp.zeros((size + 1, size + 1), lift.dtype)
    curvature = curvature.at[:size, :size].set(stiffness.reshape(size, size))
    curvature = curvature.at[:size, size].set(coupling.reshape(-1))
    curvature = curvature.at[size, :size].set(coupling.reshape(-1))
    curvature = curvature.at[size, size].set(time_stiffness)
    return jnp.append(steps_push.reshape(-1), time_push), curvature


def contact_terms(
    case: BlockCase, flight: Flight, angles: Array, time: Array, weights: Weights
) -> tuple[Array, Array, Array]:
    """Return the residuals of the contact of shield and ball at angles (n,) [rad] and a time [s].

    Returns:
        rows: (7,), weighted residuals: the ball's distance from the shield's plane; its offset from
            the shield's middle in the plane (2); the shield's tilt (2); the time by which the
            contact is before the interval `flight` or after it; the ball's distance beyond the side
            of the shield's outline that it exceeds most. Offset and tilt count only beyond the
            tolerances of the case.
        slopes: (7, n + 1), derivatives of the rows by the angles and the time.
        excess: (), largest relative excess over a tolerance, without weights.
    """
    rotation, middle = shield_pose(case.arm, angles)
    jacobian = shield_jacobian(case.arm, angles)
    ball = drag_free_flight(case.ball, time, case.gravity)
    velocity = ball.vel
    normal = rotation[:, 0]
    away = ball.pos - middle
    turns = jacobian[3:].T  # (n, 3), joint axes
    moves = jacobian[:3].T
    by_normal = jnp.cross(turns, normal)
    # Distances of the ball's centre and of its nearest point from the plane of the shield.
    height = jnp.sum(away * normal)
    off = height - case.ball_radius
    off_by_angles = product(by_normal, away) - product(moves, normal)
    off_slope = jnp.append(off_by_angles, jnp.sum(velocity * normal))
    # Offset of the ball from the shield's middle, within the plane of the shield.
    beside = away - height * normal
    beside_slope = jnp.concatenate([-moves - height * by_normal, velocity[None]])
    beside_slope -= jnp.sum(beside_slope * normal[None], axis=1)[:, None] * normal[None]
    distance = jnp.sqrt(jnp.maximum(jnp.sum(beside**2), 1e-12))
    spare = jnp.maximum(0.95 * case.offset - 0.002, 0.0)
    beside_share = jnp.maximum(1.0 - spare / distance, 0.0)
    # Tilt of the shield's normal against the reversed velocity of the ball.
    facing = face_ball(velocity)
    tilt = jnp.cross(facing, normal)
    tilt_slope = jnp.cross(facing, by_normal)
    sine = jnp.sqrt(jnp.maximum(jnp.sum(tilt**2), 1e-12))
    cosine = jnp.sum(facing * normal)
    angle = jnp.arctan2(sine, cosine)
    allowed = jnp.maximum(0.93 * case.tilt - np.deg2rad(0.5), 0.0)
    tilt_share = jnp.maximum(1.0 - allowed / angle, 0.0) * angle / sine
    frame = frame_of(facing)[:, 1:]
    early = jnp.maximum(flight.earliest + 2e-3 - time, 0.0)
    late = jnp.maximum(time - flight.latest + 2e-3, 0.0)
    edge = jnp.where(early > 0.0, -1.0, jnp.where(late > 0.0, 1.0, 0.0))
    # A contact 1 ms too early or too late weighs as much as a distance of 1 cm.
    pace = 10.0 * weights.meeting
    across = rotation[:, 1:]
    sides = shield_sides(case.arm)
    shares = product(sides, product(beside, across))
    side = sides[jnp.argmax(shares)]
    side = side / jnp.sum(side**2)  # vector from the middle to the side
    width = jnp.sqrt(jnp.sum(side**2))
    outside = jnp.maximum(jnp.max(shares) - _SPARE, 0.0) * width
    # If the allowed offsets are within the outline, the residual of the offset suffices.
    reaches = case.offset > _SPARE * shield_inradius(case.arm)
    is_outside = jnp.where(reaches & (outside > 0.0), weights.meeting, 0.0)
    outward = product(across, side / width)
    outside_slope = product(beside_slope, outward)
    outside_slope = outside_slope.at[:-1].add(product(jnp.cross(turns, outward), beside))
    # Derivative of the direction of flight by time: the component of gravity that is perpendicular
    # to the velocity, divided by the speed.
    speed_squared = jnp.maximum(jnp.sum(velocity**2), 1e-12)
    pull = jnp.zeros(3, angles.dtype).at[2].set(case.gravity)
    turning = (pull - facing * jnp.sum(facing * pull)) / jnp.sqrt(speed_squared)
    by_time = jnp.cross(turning, normal)
    rows = jnp.concatenate(
        [
            weights.meeting * off[None],
            weights.meeting * beside_share * product(beside, across),
            weights.tilt * tilt_share * product(tilt, frame),
            pace * (early + late)[None],
            (is_outside * outside)[None],
        ]
    )
    is_beside = jnp.where(beside_share > 0.0, weights.meeting, 0.0)
    is_tilted = jnp.where(tilt_share > 0.0, weights.tilt, 0.0)
    # The angle's derivative is cosine * (derivative of sine) - sine * (derivative of cosine).
    by_cosine = jnp.append(product(by_normal, facing), jnp.sum(turning * normal))
    tilt_rows = cosine * jnp.concatenate([tilt_slope, by_time[None]])
    tilt_rows = product(tilt_rows - by_cosine[:, None] * tilt[None], frame)
    slopes = jnp.concatenate(
        [
            weights.meeting * off_slope[None],
            is_beside * product(beside_slope, across).T,
            is_tilted * tilt_rows.T,
            pace * jnp.zeros((1, angles.size + 1), angles.dtype).at[0, -1].set(edge),
            is_outside * outside_slope[None],
        ]
    )
    excess = jnp.stack(
        [
            jnp.abs(off) / _PLANE - 1.0,
            distance / case.offset - 1.0,
            jnp.max(shares) - 1.0,
            angle / case.tilt - 1.0,
            jnp.maximum(flight.earliest - time, time - flight.latest) / 1e-3,
        ]
    )
    return rows, slopes, jnp.max(excess)
