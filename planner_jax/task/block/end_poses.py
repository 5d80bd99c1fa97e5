"""Arm poses in which the shield meets a ball, and residuals of this contact for least squares."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import drag_free_flight
from planner_jax.robot.arm import (
    product,
    shield_inradius,
    shield_jacobian,
    shield_pose,
    shield_sides,
)
from planner_jax.robot.arm_ik import inverse_kinematics
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.motion import Weights, profiles, step_weights
from planner_jax.task.block.scene import entry_time, rounded_entry_time

_PLANE = 1e-3  # [m], greatest distance of the ball from the shield's plane at the contact
# Tried offsets of the ball from the shield's middle along the two edges, divided by the greatest
# offset that case and shield allow.
_OFFSETS = np.array([(0.0, 0.0), (0.8, 0.0), (0.0, 0.8), (-0.8, 0.0), (0.0, -0.8)])
_SPARE = 0.95  # greatest planned fraction of the distance from the shield's middle to a side

_DELAYED = 0.4  # see `rank_straight`


@struct.dataclass
class EndPoses:
    """C arm poses in which the shield meets the ball, and the straight motions to them.

    A straight motion turns all joints in proportion from the start to the pose.
    """

    angles: Array  # (C, n) [rad], joint angles
    time: Array  # (C,) [s], of the contact of shield and ball
    # (C,), greatest ratio of a joint's rate or acceleration to its limit in the straight motion;
    # infinite if the arm cannot reach the pose.
    effort: Array
    profile: Array  # (C,) int32, speed profile of the straight motion, index in `all_profiles`
    # (C,) bool, whether the shield meets the ball within the limits of the joint angles.
    is_found: Array


@struct.dataclass
class Flight:
    """Times at which a ball enters an outer and an inner box; it must be met in between."""

    earliest: Array  # () [s], time at which the ball enters the outer box
    latest: Array  # () [s], time at which the ball enters the inner, protected box
    comes: Array  # () bool, whether the ball enters both boxes


def flight_of(case: BlockCase) -> Flight:
    """Compute when a ball enters the outer box, where it may be met, and touches the inner box."""
    scene = case.scene
    earliest, enters = entry_time(scene.outer, case.ball, case.gravity)
    radius = scene.inner_radius + case.ball_radius
    body = scene.inner, radius, case.ball, case.gravity, scene.inner_ends
    latest, hits = rounded_entry_time(*body)
    return Flight(earliest=earliest, latest=latest, comes=enters & hits & (latest > earliest))


def all_profiles(pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """Return P speed profiles (P, K), and which of them end at standstill, (P,) bool.

    A profile has a joint's rates [rad/s] at the ends of K = `pieces` equal pieces of a motion that
    starts at standstill, lasts 1 s and turns the joint by 1 rad.
    """
    at_rest, free = profiles(pieces, True), profiles(pieces, False)
    return np.concatenate([at_rest, free]), np.arange(len(at_rest) + len(free)) < len(at_rest)


def profile_peaks(pieces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the greatest rate [rad/s] and acceleration [rad/s^2] of P speed profiles, each (P,).

    The profiles turn a joint by 1 rad in 1 s. The third result is whether they end at standstill.
    """
    shapes, rests = all_profiles(pieces)
    rises = np.diff(shapes, axis=1, prepend=0.0) * pieces
    return np.max(np.abs(shapes), axis=1), np.max(np.abs(rises), axis=1), rests


def _rms_rises(pieces: int) -> np.ndarray:
    """Return the root mean square acceleration (P,) [rad/s^2] of the profiles of `all_profiles`."""
    rises = np.diff(all_profiles(pieces)[0], axis=1, prepend=0.0) * pieces
    return np.sqrt(np.mean(rises**2, axis=1))


def end_poses(
    case: BlockCase, flight: Flight, points: int, pieces: int, *, every: int = 1
) -> EndPoses:
    """Return the arm poses that meet the ball at each of `points` points of its path.

    The points lie where the ball has entered the outer box but not the inner box. The poses are the
    solutions of the inverse kinematics. The last joint keeps its angle if it only turns the shield
    in its own plane. A straight motion of `pieces` pieces leads to each pose. Its speed profile is
    the one that stays farthest below the joints' limits. Only the points that `thin_points` selects
    have poses.
    """
    chosen = thin_points(points, every)
    time = flight.earliest + (chosen + 0.5) / points * (flight.latest - flight.earliest)
    # Within the outline of the shield, which may have any rotation about its normal.
    most = jnp.minimum(case.offset, shield_inradius(case.arm))
    offset = most * jnp.asarray(_OFFSETS[chosen % len(_OFFSETS)], time.dtype)
    return poses_at(case, flight, time, offset, pieces)


def poses_at(
    case: BlockCase,
    flight: Flight,
    time: Array,
    offset: Array,
    pieces: int,
    tilt: Array | None = None,
) -> EndPoses:
    """Return the arm poses that meet the ball at P times; see `end_poses`.

    Args:
        case: the case.
        flight: times between which the ball may be met.
        time: (P,) [s], of the contacts.
        offset: (P, 2) [m], of the ball from the shield's middle, along two edges.
        pieces: number of pieces of the straight motions.
        tilt: (P, 2) [rad], of the shield's normal from the reversed velocity of the ball, towards
            the two other axes of `frame_of`; by default 0.
    """

    def solve_point(time: Array, offset: Array, tilt: Array | None) -> tuple[Array, Array]:
        ball = drag_free_flight(case.ball, time, case.gravity)
        rotation = frame_of(face_ball(ball.vel))
        if tilt is not None:
            angle = jnp.sqrt(jnp.maximum(jnp.sum(tilt**2), 1e-12))
            lean = jnp.append(jnp.cos(angle), tilt * jnp.sin(angle) / angle)
            rotation = frame_of(product(rotation, lean))
        shift = offset[0] * rotation[:, 1] + offset[1] * rotation[:, 2]
        shift -= case.ball_radius * rotation[:, 0]
        return inverse_kinematics(case.arm, rotation, ball.pos + shift, is_roll_free=True)

    angles, found = jax.vmap(solve_point)(time, offset, tilt)
    if case.arm.turns_in_plane:
        angles = angles.at[:, :, -1].set(case.angles[-1])
    time = jnp.repeat(time, angles.shape[1])
    angles = angles.reshape(-1, case.arm.num)
    _, rates, rises = _shares_of_limits(case, angles, time, pieces)
    efforts = jnp.maximum(rates, rises)
    exists = found.reshape(-1) & (time > case.delay) & flight.comes
    return EndPoses(
        angles=angles,
        time=time,
        effort=jnp.where(exists, jnp.min(efforts, axis=1), jnp.inf),
        profile=jnp.argmin(efforts, axis=1).astype(jnp.int32),
        is_found=found.reshape(-1) & flight.comes,
    )


def thin_points(points: int, every: int) -> np.ndarray:
    """Return the indices of the last of `points` points, and of every `every`-th before it."""
    return np.arange(points)[::-every][::-1]


def rank_straight(
    case: BlockCase,
    poses: EndPoses,
    points: int,
    every: int,
    pieces: int,
    most: float,
    is_quick: bool,
) -> tuple[EndPoses, Array, Array]:
    """Return poses with profiles of least cost, the order in which to check them, and their number.

    The cost of a straight motion is the root mean square of the joints' accelerations divided by
    their limits. With `is_quick`, a motion from standstill to standstill is as fast as its limits
    allow, and the cost is its duration [s]. The order is by rising cost. A pose for which the same
    branch of the inverse kinematics has k poses of less cost is ranked as if its cost were larger
    by the factor 1 + 0.4 k. The first motions in the order thus differ in their branches.

    Args:
        case: the case.
        poses: poses at each of `points` points of the ball's path, from `end_poses`.
        points: number of points. The function ranks the poses at the points that `thin_points`
            selects.
        every: argument of `thin_points`.
        pieces: number of pieces of each motion.
        most: greatest allowed ratio of a rate or acceleration to its limit.
        is_quick: whether motions are as fast as the limits allow.
    """
    load, rates, rises = _shares_of_limits(case, poses.angles, poses.time, pieces)
    costs = load[:, None] * jnp.asarray(_rms_rises(pieces), load.dtype)[None]
    if is_quick:
        paces = jnp.maximum(rates, jnp.sqrt(rises)) * (poses.time - case.delay)[:, None]
        costs = jnp.where(case.ends_at_rest, paces, costs)
    costs = jnp.where(jnp.maximum(rates, rises) <= most, costs, jnp.inf)
    is_ranked = np.isin(np.arange(points), thin_points(points, every))
    is_ranked = is_ranked.repeat(len(poses.time) // points) & (poses.effort <= most)
    cost = jnp.where(is_ranked, jnp.min(costs, axis=1), jnp.inf)
    behind = jnp.argsort(jnp.argsort(cost.reshape(points, -1), axis=0), axis=0)
    order = jnp.argsort(cost * (1.0 + _DELAYED * behind.reshape(-1).astype(cost.dtype)))
    profile = jnp.argmin(costs, axis=1).astype(jnp.int32)
    return dataclasses.replace(poses, profile=profile), order, jnp.sum(is_ranked)


def _shares_of_limits(
    case: BlockCase, angles: Array, time: Array, pieces: int
) -> tuple[Array, Array, Array]:
    """Return shares of limits in straight motions to C poses at `angles` (C, n) and `time` (C,).

    `all_profiles` returns the P speed profiles. If the case does not allow a profile, the shares of
    its motions are infinite.

    Returns:
        load: (C,), root mean square of the joints' angles turned, divided by the limits of
            acceleration and the square of the duration.
        rates: (C, P), greatest ratio of a joint's rate to its limit.
        rises: (C, P), greatest ratio of a joint's acceleration to its limit.
    """
    duration = jnp.maximum(time - case.delay, 1e-3)
    turned = jnp.abs(angles - coast(case, duration, pieces))
    rates, rises, rests = profile_peaks(pieces)
    of_rate = jnp.max(turned / case.limits.velocity[None], axis=1) / duration
    loads = turned / case.limits.acceleration[None] / duration[:, None] ** 2
    of_rates = of_rate[:, None] * rates[None]
    of_rises = jnp.max(loads, axis=1)[:, None] * rises[None]
    is_allowed = rests | ~case.ends_at_rest
    load = jnp.sqrt(jnp.mean(loads**2, axis=1))
    of_rates, of_rises = (jnp.where(is_allowed, each, jnp.inf) for each in (of_rates, of_rises))
    return load, of_rates, of_rises


def coast(case: BlockCase, duration: Array, pieces: int) -> Array:
    """Return the joint angles (..., n) [rad] at standstill after braking in a motion's first piece.

    The motion has `pieces` equal pieces and the `duration` (...) [s]. It starts at the case's joint
    angles and rates.
    """
    of_first = step_weights(pieces, (1.0,))[0][0]
    shape = *duration.shape, case.arm.num
    angles, rates = (jnp.broadcast_to(x, shape) for x in (case.angles, case.rates))
    return angles + of_first * duration[..., None] * rates


def face_ball(velocity: Array) -> Array:
    """Return the shield's normal (3,) that faces a ball: the reversed direction of its velocity."""
    return -velocity / jnp.sqrt(jnp.maximum(jnp.sum(velocity**2), 1e-12))


def frame_of(normal: Array) -> Array:
    """Return a rotation (3, 3) whose first column is `normal` (3,), the second one horizontal."""
    flat = jnp.sqrt(jnp.maximum(normal[0] ** 2 + normal[1] ** 2, 1e-12))
    side = jnp.stack([-normal[1], normal[0], jnp.zeros_like(flat)]) / flat
    return jnp.stack([normal, side, jnp.cross(normal, side)], axis=1)


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
    beside_slope = jnp.concatenate([-moves, velocity[None]])
    beside_slope -= jnp.sum(beside_slope * normal[None], axis=1)[:, None] * normal[None]
    distance = jnp.sqrt(jnp.maximum(jnp.sum(beside**2), 1e-12))
    spare = jnp.maximum(0.95 * case.offset - 0.002, 0.0)
    beside_share = jnp.maximum(1.0 - spare / distance, 0.0)
    # Tilt of the shield's normal against the reversed velocity of the ball.
    facing = face_ball(velocity)
    tilt = jnp.cross(facing, normal)
    tilt_slope = jnp.cross(facing, by_normal)
    sine = jnp.sqrt(jnp.maximum(jnp.sum(tilt**2), 1e-12))
    angle = jnp.arctan2(sine, jnp.sum(facing * normal))
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
    tilt_rows = product(jnp.concatenate([tilt_slope, by_time[None]]), frame)
    slopes = jnp.concatenate(
        [
            weights.meeting * off_slope[None],
            is_beside * product(beside_slope, across).T,
            is_tilted * tilt_rows.T,
            pace * jnp.zeros((1, angles.size + 1), angles.dtype).at[0, -1].set(edge),
            is_outside * product(beside_slope, product(across, side / width))[None],
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
