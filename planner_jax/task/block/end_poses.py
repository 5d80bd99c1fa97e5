"""Poses at which the shield meets a ball, how well, and the straight motions that lead there."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import drag_free_flight
from planner_jax.robot.arm import product, shield_jacobian, shield_pose
from planner_jax.robot.arm_ik import inverse_kinematics
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.motion import Weights, profiles, sums
from planner_jax.task.block.scene import entry_time

_PLANE = 1e-3  # [m], how far from the shield's plane the ball may be at the contact
# Where on the shield balls are met, in shares of the greatest offset: along its two edges.
_PLACES = np.array([(0.0, 0.0), (0.8, 0.0), (0.0, 0.8), (-0.8, 0.0), (0.0, -0.8)])


@struct.dataclass
class EndPoses:
    """C poses, and the effort of the straight motion to each."""

    angles: Array  # (C, 6) [rad]
    time: Array  # (C,) [s], of the contact
    effort: Array  # (C,), greatest share of a limit that the motion takes; infinite without a pose
    profile: Array  # (C,) int32, place in `all_profiles`


@struct.dataclass
class Flight:
    """The times at which a ball can be met."""

    earliest: Array  # () [s], when it gets into the outer box
    latest: Array  # () [s], when it gets into the inner one
    comes: Array  # () bool, whether it does both


def flight_of(case: BlockCase) -> Flight:
    """Return when the ball of a case can be met."""
    scene = case.scene
    earliest, enters = entry_time(scene.outer, case.ball, case.gravity)
    latest, hits = entry_time(scene.inner, case.ball, case.gravity)
    return Flight(earliest=earliest, latest=latest, comes=enters & hits & (latest > earliest))


def all_profiles(pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the profiles (P, K) of `motion.profiles`, and which end at rest, (P,) bool."""
    at_rest, free = profiles(pieces, True), profiles(pieces, False)
    return np.concatenate([at_rest, free]), np.arange(len(at_rest) + len(free)) < len(at_rest)


def profile_peaks(pieces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return peak rates and accelerations of all profiles (P,) in 1 s, and which end at rest."""
    shapes, rests = all_profiles(pieces)
    rises = np.diff(shapes, axis=1, prepend=0.0) * pieces
    return np.max(np.abs(shapes), axis=1), np.max(np.abs(rises), axis=1), rests


def end_poses(
    case: BlockCase, flight: Flight, points: int, pieces: int, *, quickest: bool = False
) -> EndPoses:
    """Return eight poses at each of some points of the ball's path between the boxes.

    The joint at the flange, whose turns leave the ball on the shield, stays as it is. Straight
    motions of so many pieces have the profile of the least effort, or, from rest to rest, of the
    least time if `quickest`.
    """
    share = (np.arange(points) + 0.5) / points
    time = flight.earliest + share * (flight.latest - flight.earliest)
    place = case.offset * jnp.asarray(_PLACES[np.arange(points) % len(_PLACES)], time.dtype)

    def of_point(time: Array, place: Array) -> tuple[Array, Array]:
        ball = drag_free_flight(case.ball, time, case.gravity)
        rotation = frame_of(face_ball(ball.vel))
        shift = place[0] * rotation[:, 1] + place[1] * rotation[:, 2]
        return inverse_kinematics(case.arm, rotation, ball.pos + shift)

    angles, found = jax.vmap(of_point)(time, place)
    angles = angles.at[:, :, 5].set(case.angles[5]).reshape(-1, 6)
    time = jnp.repeat(time, 8)
    duration = jnp.maximum(time - case.delay, 1e-3)
    turned = jnp.abs(angles - coast(case, duration, pieces))
    rates, rises, rests = profile_peaks(pieces)
    of_rate = jnp.max(turned / case.limits.velocity, axis=1) / duration
    of_rise = jnp.max(turned / case.limits.acceleration, axis=1) / duration**2
    of_rates, of_rises = of_rate[:, None] * rates, of_rise[:, None] * rises
    efforts = jnp.maximum(of_rates, of_rises)
    is_one = rests | ~case.ends_at_rest
    paces = efforts
    if quickest:
        paces = jnp.where(case.ends_at_rest, jnp.maximum(of_rates, jnp.sqrt(of_rises)), efforts)
    profile = jnp.argmin(jnp.where(is_one, paces, jnp.inf), axis=1)
    effort = jnp.min(jnp.where(is_one, efforts, jnp.inf), axis=1)
    is_there = found.reshape(-1) & (time > case.delay) & flight.comes
    return EndPoses(
        angles=angles,
        time=time,
        effort=jnp.where(is_there, effort, jnp.inf),
        profile=profile.astype(jnp.int32),
    )


def coast(case: BlockCase, duration: Array, pieces: int) -> Array:
    """Return where joints stop, (..., 6) [rad], if they brake evenly in the first piece."""
    of_first = sums(pieces, (1.0,))[0][0]
    return case.angles + of_first * duration[..., None] * case.rates


def face_ball(velocity: Array) -> Array:
    """Return the direction (3,) against a ball's velocity (3,)."""
    square = jnp.maximum(jnp.sum(velocity**2), 1e-12)
    return -velocity / jnp.sqrt(square)


def frame_of(normal: Array) -> Array:
    """Return a rotation (3, 3) whose first column is a direction (3,) and second is horizontal."""
    flat = jnp.sqrt(jnp.maximum(normal[0] ** 2 + normal[1] ** 2, 1e-12))
    side = jnp.stack([-normal[1], normal[0], jnp.zeros_like(flat)]) / flat
    return jnp.stack([normal, side, jnp.cross(normal, side)], axis=1)


def contact_terms(
    case: BlockCase, flight: Flight, angles: Array, time: Array, weights: Weights
) -> tuple[Array, Array, Array]:
    """Return the residuals of a contact at angles (6,) [rad] and a time () [s].

    Returns:
        rows: (7,): off the plane, off the middle, tilted, too early or late.
        slopes: (7, 7), by the angles and the time.
        excess: (), largest over a limit, relative, whatever the weights.
    """
    rotation, middle = shield_pose(case.arm, angles)
    jacobian = shield_jacobian(case.arm, angles)
    ball = drag_free_flight(case.ball, time, case.gravity)
    velocity = ball.vel
    normal = rotation[:, 0]
    away = ball.pos - middle
    turns = jacobian[3:].T  # (6, 3), the axes
    moves = jacobian[:3].T
    by_normal = jnp.cross(turns, normal)
    # Off the plane of the shield.
    off = jnp.sum(away * normal)
    off_slope = jnp.append(
        product(by_normal, away) - product(moves, normal), jnp.sum(velocity * normal)
    )
    # Off its middle, within the plane.
    beside = away - off * normal
    beside_slope = jnp.concatenate([-moves, velocity[None]])
    beside_slope -= jnp.sum(beside_slope * normal, axis=1)[:, None] * normal
    distance = jnp.sqrt(jnp.maximum(jnp.sum(beside**2), 1e-12))
    spare = jnp.maximum(0.95 * case.offset - 0.002, 0.0)
    beside_share = jnp.maximum(1.0 - spare / distance, 0.0)
    # Tilted against the ball's path.
    wanted = face_ball(velocity)
    tilt = jnp.cross(wanted, normal)
    tilt_slope = jnp.cross(wanted, by_normal)
    sine = jnp.sqrt(jnp.maximum(jnp.sum(tilt**2), 1e-12))
    angle = jnp.arctan2(sine, jnp.sum(wanted * normal))
    room = jnp.maximum(0.93 * case.tilt - np.deg2rad(0.5), 0.0)
    tilt_share = jnp.maximum(1.0 - room / angle, 0.0) * angle / sine
    frame = frame_of(wanted)[:, 1:]
    early = jnp.maximum(flight.earliest + 2e-3 - time, 0.0)
    late = jnp.maximum(time - flight.latest + 2e-3, 0.0)
    edge = jnp.where(early > 0.0, -1.0, jnp.where(late > 0.0, 1.0, 0.0))
    # A millisecond counts as much as a centimetre.
    pace = 10.0 * weights.meeting
    across = rotation[:, 1:]
    # The ball's path bends: its direction turns with the part of gravity across it.
    pace_squared = jnp.maximum(jnp.sum(velocity**2), 1e-12)
    pull = jnp.zeros(3, angles.dtype).at[2].set(case.gravity)
    bent = (pull - wanted * jnp.sum(wanted * pull)) / jnp.sqrt(pace_squared)
    by_time = jnp.cross(bent, normal)
    rows = jnp.concatenate(
        [
            weights.meeting * off[None],
            weights.meeting * beside_share * product(beside, across),
            weights.tilt * tilt_share * product(tilt, frame),
            pace * (early + late)[None],
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
            pace * jnp.zeros((1, 7), angles.dtype).at[0, 6].set(edge),
        ]
    )
    excess = jnp.stack(
        [
            jnp.abs(off) / _PLANE - 1.0,
            distance / case.offset - 1.0,
            angle / case.tilt - 1.0,
            jnp.maximum(flight.earliest - time, time - flight.latest) / 1e-3,
        ]
    )
    return rows, slopes, jnp.max(excess)
