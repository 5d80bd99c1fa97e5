"""Obstacles in the plane: convex polygons and circles that move, and distances from them."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jax.typing import ArrayLike


@struct.dataclass
class Track:
    """Poses of N obstacles at K equally spaced times each, between which they change linearly.

    An obstacle exists only from its first to its last time.
    """

    poses: Array  # (N, K, 3) x [m], y [m], heading [rad]
    begin: Array  # (N,) [s], time of the first pose
    step: Array  # (N,) [s], time between two poses
    end: Array  # (N,) [s], time of the last pose that is not padding


@struct.dataclass
class Obstacles:
    """Up to N convex polygons of up to V corners each, enlarged by a radius, which move.

    World frame in the plane, SI units. Without a track an obstacle does not turn. Its velocity is
    constant ([Qu2022, eq. 5], with constant speeds as in its Section IV-A), and zero for walls.

    Attributes:
        centre: (N, 2) [m], centres of the polygons at time 0.
        corners: (N, V, 2) [m], corners relative to the centre, counter-clockwise, padded with the
            last corner.
        velocity: (N, 2) [m/s], velocities of the polygons.
        present: (N,) bool, whether the entry is an obstacle or only padding.
        radius: (N,) [m], distance by which the polygon is enlarged at time 0.
        growth: (N,) [m/s], rate at which `radius` grows after time 0.
        track: poses of the polygons' frames; replaces `centre` and `velocity`.
    """

    centre: Array
    corners: Array
    velocity: Array
    present: Array
    radius: Array
    growth: Array
    track: Track | None = None

    def vertices(self, time: ArrayLike) -> Array:
        """Return the V corners of the N obstacles at one time () [s], (N, V, 2) [m].

        The corners of absent obstacles are also returned. Circles are not enlarged by their radius.
        """
        if self.track is None:
            return (self.centre + self.velocity * time)[..., None, :] + self.corners
        placed = place(self, jnp.asarray(time)[None])
        middle = jnp.stack([placed.x, placed.y], axis=-1)
        return middle + jnp.stack(placed.leave(self.corners[..., 0], self.corners[..., 1]), axis=-1)


@struct.dataclass
class Placement:
    """N obstacles at M times: their frames, in which the corners do not move, and their motion."""

    x: Array  # (N, M) [m], origin of the frame
    y: Array  # (N, M) [m]
    velocity: tuple[Array, Array]  # (N, M) [m/s] each, of the origin along x and y
    turn: tuple[Array, Array, Array] | None  # cosine and sine of the heading, turn rate [rad/s]
    radius: Array  # (N, M) [m], distance by which the polygons are enlarged
    present: Array  # (N, M) bool

    def enter(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return points (N, M) [m] of the world frame in the frames of the obstacles."""
        x, y = x - self.x, y - self.y
        if self.turn is None:
            return x, y
        cos, sin, _ = self.turn
        return cos * x + sin * y, cos * y - sin * x

    def leave(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return directions (N, M) of the frames of the obstacles in the world frame."""
        if self.turn is None:
            return x, y
        cos, sin, _ = self.turn
        return cos * x - sin * y, sin * x + cos * y


def place(group: Obstacles, times: Array) -> Placement:
    """Return where N obstacles are at M times (M,) [s]."""
    times = times[None]
    radius = group.radius[:, None] + group.growth[:, None] * jnp.maximum(times, 0.0)
    track = group.track
    if track is None:
        x, y = (group.centre[:, k, None] + group.velocity[:, k, None] * times for k in range(2))
        velocity = (group.velocity[:, :1], group.velocity[:, 1:])
        return Placement(x, y, velocity, None, radius, group.present[:, None])
    num = track.poses.shape[1]
    at = (times - track.begin[:, None]) / track.step[:, None]
    below = jnp.clip(jnp.floor(at), 0, num - 2).astype(jnp.int32)
    before, after = (
        jnp.take_along_axis(track.poses, (below + k)[..., None], axis=1) for k in range(2)
    )
    is_between = (times >= track.begin[:, None]) & (times <= track.end[:, None])
    rate = (after - before) / track.step[:, None, None]
    share = (at - below.astype(at.dtype))[..., None]
    pose = before + jnp.clip(share, 0.0, 1.0) * (after - before)
    turn = (jnp.cos(pose[..., 2]), jnp.sin(pose[..., 2]), rate[..., 2])
    present = group.present[:, None] & is_between
    return Placement(
        pose[..., 0], pose[..., 1], (rate[..., 0], rate[..., 1]), turn, radius, present
    )


def move_on(group: Obstacles, elapsed: ArrayLike) -> Obstacles:
    """Return obstacles whose time 0 is `elapsed` () or (B,) [s] later; their growth continues."""
    elapsed = jnp.asarray(elapsed)
    centre = group.centre + group.velocity * elapsed[..., None, None]
    radius = group.radius + group.growth * elapsed[..., None]
    track = group.track
    if track is not None:
        begin, end = (each - elapsed[..., None] for each in (track.begin, track.end))
        track = dataclasses.replace(track, begin=begin, end=end)
    return dataclasses.replace(group, centre=centre, radius=radius, track=track)


def join_obstacles(first: Obstacles, second: Obstacles) -> Obstacles:
    """Join two groups of obstacles; repeat corners and poses for equal numbers per polygon.

    If only the second group has a track, the obstacles of the first group stand still.
    """
    size = max(first.corners.shape[-2], second.corners.shape[-2])
    tracks = [each.track for each in (first, second) if each.track is not None]
    num = max((track.poses.shape[-2] for track in tracks), default=0)

    def pad(group: Obstacles) -> Obstacles:
        corners = _repeat_last(group.corners, size)
        track = group.track
        if num and track is None:
            still = jnp.zeros_like(group.radius)
            far = jnp.full_like(still, 1e6)
            poses = jnp.concatenate([group.centre, still[..., None]], axis=-1)[..., None, :]
            track = Track(poses, -far, 2.0 * far, far)
        if track is not None:
            track = dataclasses.replace(track, poses=_repeat_last(track.poses, num))
        return dataclasses.replace(group, corners=corners, track=track)

    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), pad(first), pad(second))


def _repeat_last(rows: Array, num: int) -> Array:
    return jnp.concatenate([rows, *[rows[..., -1:, :]] * (num - rows.shape[-2])], axis=-2)


def distances(
    corners: Array, present: Array, x: Array, y: Array
) -> tuple[Array, tuple[Array, Array]]:
    """Return the signed distances of points from convex polygons, and their gradients.

    Args:
        corners: (N, V, 2) [m], V corners of N polygons, counter-clockwise; may be repeated.
        present: (N,) or (N, P) bool; absent polygons get the distance 1000.
        x: (N, P) or (1, P) [m], P points for each polygon, or P points for all polygons.
        y: (N, P) or (1, P) [m].

    Returns:
        distance: (N, P) [m]. Inside a polygon it is minus the distance of the nearest edge's line.
            The distance from a polygon without edges is the distance from its corner.
        away: gradient of the distance, a unit vector: its x and y components, each (N, P).
    """
    before = jnp.roll(corners, 1, axis=1)
    edge = corners - before
    square = jnp.sum(edge**2, axis=2)
    is_edge = square > 1e-10
    inverse = jnp.where(is_edge, 1.0 / jnp.where(is_edge, square, 1.0), 0.0)
    root = jnp.sqrt(inverse)
    shape = jnp.broadcast_shapes((corners.shape[0], 1), x.shape)
    nearest, highest = jnp.full(shape, 1e6, x.dtype), jnp.full(shape, -1e6, x.dtype)
    gap_x = gap_y = face_x = face_y = jnp.zeros(shape, x.dtype)
    # The loop takes one edge at a time, so that the points' coordinates stay in registers.
    for k in range(corners.shape[1]):
        exists = is_edge[:, k, None]
        from_x, from_y = x - before[:, k, :1], y - before[:, k, 1:]
        edge_x, edge_y = edge[:, k, :1], edge[:, k, 1:]
        share = jnp.clip((from_x * edge_x + from_y * edge_y) * inverse[:, k, None], 0.0, 1.0)
        to_x, to_y = from_x - share * edge_x, from_y - share * edge_y
        away = to_x**2 + to_y**2
        closer = away < nearest
        nearest = jnp.where(closer, away, nearest)
        gap_x, gap_y = jnp.where(closer, to_x, gap_x), jnp.where(closer, to_y, gap_y)
        normal_x, normal_y = edge_y * root[:, k, None], -edge_x * root[:, k, None]
        height = from_x * normal_x + from_y * normal_y
        higher = exists & (height > highest)
        highest = jnp.where(higher, height, highest)
        face_x, face_y = jnp.where(higher, normal_x, face_x), jnp.where(higher, normal_y, face_y)
    outside = (highest > 0.0) | ~jnp.any(is_edge, axis=1)[:, None]
    length = jnp.sqrt(jnp.maximum(nearest, 1e-12))
    distance = jnp.where(outside, length, highest)
    direction = (
        jnp.where(outside, gap_x / length, face_x),
        jnp.where(outside, gap_y / length, face_y),
    )
    present = present.reshape(corners.shape[0], -1)
    return jnp.where(present, distance, 1e3), direction


def separation(
    corners: Array, present: Array, x: Array, y: Array, heading: Array, body: tuple
) -> Array:
    """Return the gaps [m] between a rectangle at P poses and N polygons, (N, P).

    A gap is the greatest separation along an axis normal to an edge. It is positive if and only if
    rectangle and polygon do not touch (the separating axis theorem), and is at most their distance.

    Args:
        corners: (N, V, 2) [m], V corners of N polygons, counter-clockwise; may be repeated.
        present: (N,) or (N, P) bool; absent polygons get the gap 1000.
        x: (N, P) or (1, P) [m], P positions of a reference point on the rectangle's long axis.
        y: (N, P) or (1, P) [m].
        heading: (P,) or (N, P) [rad], direction of the long axis.
        body: coordinates [m] along the long axis of the rectangle's rear and front ends, relative
            to the reference point, and half its width [m].
    """
    behind, ahead, half = body
    heading = heading.reshape(-1, x.shape[1])
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    ends = [(a, b) for a in (behind, ahead) for b in (-half, half)]
    points = [(x + a * cos - b * sin, y + a * sin + b * cos) for a, b in ends]
    before = jnp.roll(corners, 1, axis=1)
    edge = corners - before
    square = jnp.sum(edge**2, axis=2)
    is_edge = square > 1e-10
    root = 1.0 / jnp.sqrt(jnp.where(is_edge, square, 1.0))
    best = jnp.full(jnp.broadcast_shapes((corners.shape[0], 1), x.shape), -1e6, x.dtype)
    low = [jnp.full_like(best, 1e6), jnp.full_like(best, 1e6)]
    high = [jnp.full_like(best, -1e6), jnp.full_like(best, -1e6)]
    for k in range(corners.shape[1]):
        normal_x, normal_y = edge[:, k, 1:] * root[:, k, None], -edge[:, k, :1] * root[:, k, None]
        heights = [
            (px - before[:, k, :1]) * normal_x + (py - before[:, k, 1:]) * normal_y
            for px, py in points
        ]
        least = jnp.minimum(
            jnp.minimum(heights[0], heights[1]), jnp.minimum(heights[2], heights[3])
        )
        best = jnp.where(is_edge[:, k, None], jnp.maximum(best, least), best)
        from_x, from_y = corners[:, k, :1] - x, corners[:, k, 1:] - y
        for axis, height in enumerate((from_x * cos + from_y * sin, from_y * cos - from_x * sin)):
            low[axis] = jnp.minimum(low[axis], height)
            high[axis] = jnp.maximum(high[axis], height)
    along = jnp.maximum(low[0] - ahead, behind - high[0])
    across = jnp.maximum(low[1] - half, -half - high[1])
    best = jnp.maximum(best, jnp.maximum(along, across))
    return jnp.where(present.reshape(corners.shape[0], -1), best, 1e3)
