"""Poses at which the shield meets a ball, and straight motions of the joints that lead there."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import drag_free_flight
from planner_jax.robot.arm_ik import inverse_kinematics
from planner_jax.task.block.case import BlockCase
from planner_jax.task.block.motion import profiles, sums
from planner_jax.task.block.scene import entry_time

# Where on the shield balls are met, in shares of the greatest offset: along its two edges.
_PLACES = np.array([(0.0, 0.0), (0.8, 0.0), (0.0, 0.8), (-0.8, 0.0), (0.0, -0.8)])


@struct.dataclass
class EndPoses:
    """C poses, and what the straight motion to each asks of the joints."""

    angles: Array  # (C, 6) [rad]
    time: Array  # (C,) [s], of the contact
    effort: Array  # (C,), greatest share of a limit that the motion takes; infinite without a pose
    profile: Array  # (C,) int32, place in `all_profiles`


@struct.dataclass
class Flight:
    """When a ball can be met."""

    earliest: Array  # () [s], when it gets into the outer box
    latest: Array  # () [s], when it gets into the inner one
    comes: Array  # () bool, whether it does both


def flight_of(case: BlockCase) -> Flight:
    """When the ball of a case can be met."""
    scene = case.scene
    earliest, enters = entry_time(scene.outer, case.ball, case.gravity)
    latest, hits = entry_time(scene.inner, case.ball, case.gravity)
    return Flight(earliest=earliest, latest=latest, comes=enters & hits & (latest > earliest))


def all_profiles(pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """Profiles (P, K) of `motion.profiles`, and which of them end at rest, (P,) bool."""
    at_rest, free = profiles(pieces, True), profiles(pieces, False)
    return np.concatenate([at_rest, free]), np.arange(len(at_rest) + len(free)) < len(at_rest)


def profile_peaks(pieces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of all profiles (P,) in 1 s: greatest rates and accelerations, and which end at rest."""
    shapes, rests = all_profiles(pieces)
    rises = np.diff(shapes, axis=1, prepend=0.0) * pieces
    return np.max(np.abs(shapes), axis=1), np.max(np.abs(rises), axis=1), rests


def end_poses(
    case: BlockCase, flight: Flight, points: int, pieces: int, *, quickest: bool = False
) -> EndPoses:
    """Eight poses at each of some points of the ball's way between the boxes.

    The joint at the flange, whose turns leave the ball on the shield, stays as it is.

    Args:
        case: one case.
        flight: of its ball.
        points: P, of the ball's way.
        pieces: of the straight motions.
        quickest: whether motions from rest to rest have the profile that could be made in the
            least time, not that of the least effort.
    """
    share = (np.arange(points) + 0.5) / points
    time = flight.earliest + share * (flight.latest - flight.earliest)
    place = case.offset * jnp.asarray(_PLACES[np.arange(points) % len(_PLACES)], time.dtype)

    def of_point(time: Array, place: Array) -> tuple[Array, Array]:
        ball = drag_free_flight(case.ball, time, case.gravity)
        rotation = frame_of(facing(ball.vel))
        shift = place[0] * rotation[:, 1] + place[1] * rotation[:, 2]
        return inverse_kinematics(case.arm, rotation, ball.pos + shift)

    angles, found = jax.vmap(of_point)(time, place)
    angles = angles.at[:, :, 5].set(case.angles[5]).reshape(-1, 6)
    time = jnp.repeat(time, 8)
    duration = jnp.maximum(time - case.delay, 1e-3)
    turned = jnp.abs(angles - coasted(case, duration, pieces))
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


def coasted(case: BlockCase, duration: Array, pieces: int) -> Array:
    """Where the joints come to rest, (..., 6) [rad], if they brake evenly in the first piece."""
    of_first = sums(pieces, (1.0,))[0][0]
    return case.angles + of_first * duration[..., None] * case.rates


def facing(velocity: Array) -> Array:
    """The direction (3,) against a ball's velocity (3,)."""
    square = jnp.maximum(jnp.sum(velocity**2), 1e-12)
    return -velocity / jnp.sqrt(square)


def frame_of(normal: Array) -> Array:
    """A rotation (3, 3) whose first column is a direction (3,), and the second one horizontal."""
    flat = jnp.sqrt(jnp.maximum(normal[0] ** 2 + normal[1] ** 2, 1e-12))
    side = jnp.stack([-normal[1], normal[0], jnp.zeros_like(flat)]) / flat
    return jnp.stack([normal, side, jnp.cross(normal, side)], axis=1)
