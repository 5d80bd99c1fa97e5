"""Arm poses in which the shield meets a ball, and the straight motions to them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import drag_free_flight
from planner_jax.robot.arm import product, shield_inradius
from planner_jax.robot.arm_ik import inverse_kinematics
from planner_jax.robot.arm_motion import profiles, step_weights
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.problem.flight import Flight

# Tried offsets of the ball from the shield's middle along the two edges, divided by the greatest
# offset that case and shield allow.
_OFFSETS = np.array([(0.0, 0.0), (0.8, 0.0), (0.0, 0.8), (-0.8, 0.0), (0.0, -0.8)])
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
