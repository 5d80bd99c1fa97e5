"""Obstacles in the plane: convex polygons at constant velocity, and distances from them."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import ArrayLike

from planner_jax.core.checks import floating, shape_of
from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.plane.polygons import Geometry, convex_parts

_COUNTS = (16, 32, 64)  # numbers of entries of `obstacles`; then multiples of the last
_CORNERS = 8  # least number of corners of an entry of `obstacles`; then its doubles


@struct.dataclass
class Obstacles:
    """Up to N convex polygons of up to V corners each, which move without turning.

    World frame in the plane, SI units. The velocity of an obstacle is constant ([Qu2022, eq. 5],
    with constant speeds as in its Section IV-A), and zero for walls.
    """

    centre: Array  # (N, 2) [m], at time 0
    corners: Array  # (N, V, 2) [m] from the centre, counter-clockwise, padded with the last corner
    velocity: Array  # (N, 2) [m/s]
    present: Array  # (N,) bool, whether the entry is an obstacle or only padding

    def vertices(self, time: ArrayLike) -> Array:
        """Return the V corners of the N obstacles at one time () [s], (N, V, 2) [m]."""
        return (self.centre + self.velocity * time)[..., None, :] + self.corners


def obstacles(
    polygons: object, velocities: object = 0.0, *, dtype: object = jnp.float32
) -> Obstacles:
    """Make the obstacles of one case from lists of corners.

    The arrays are padded to 16, 32, 64, 128, 192, ... obstacles of 8, 16, 32, 64, ... corners.
    Cases whose arrays have equal sizes share a compiled program.

    Args:
        polygons: a sequence with one polygon for each obstacle, at time 0: an array of corners
            (V, 2) [m], in either orientation, or a geometry of Shapely of the type Polygon or
            MultiPolygon, with or without holes. Each has its own number V of corners. A polygon
            that is not convex becomes several entries, its convex parts, with equal velocities.
            One geometry alone is one obstacle.
        velocities: (2,) [m/s] for all obstacles, or (N, 2), one for each of N obstacles.
        dtype: floating type of the arrays.

    Raises:
        TypeError: an argument has a wrong type.
        ValueError: a polygon has no area, or its edges cross. The message names the polygon.
    """
    dtype = floating(dtype)
    if isinstance(polygons, Geometry):
        polygons = [polygons]
    if isinstance(polygons, str) or not isinstance(polygons, Sequence | np.ndarray):
        raise ArgumentTypeError("polygons", "a sequence of polygons", polygons)
    parts = [convex_parts("polygons", polygon, k) for k, polygon in enumerate(polygons)]
    checked = [part for each in parts for part in each]
    num, most = len(checked), max((len(each) for each in checked), default=3)
    num = next((count for count in _COUNTS if num <= count), -(-num // _COUNTS[-1]) * _COUNTS[-1])
    size = max(_CORNERS, 1 << (most - 1).bit_length())
    shape = shape_of("velocities", velocities)
    if shape not in ((), (2,), (len(parts), 2)):
        rule = f"the shape (2,) or ({len(parts)}, 2)"
        raise ArgumentError("velocities", rule, shape, verb="have")
    require(bool(np.isfinite(np.asarray(velocities)).all()), "velocities", "finite", velocities)
    speeds = np.broadcast_to(np.asarray(velocities, float), (len(parts), 2))
    speeds = speeds.repeat([len(each) for each in parts], axis=0)
    centre, velocity = np.zeros((num, 2)), np.zeros((num, 2))
    corners = np.zeros((num, size, 2))
    for k, polygon in enumerate(checked):
        centre[k], velocity[k] = polygon.mean(axis=0), speeds[k]
        corners[k] = polygon[np.minimum(np.arange(size), len(polygon) - 1)] - centre[k]
    return Obstacles(
        centre=jnp.asarray(centre, dtype),
        corners=jnp.asarray(corners, dtype),
        velocity=jnp.asarray(velocity, dtype),
        present=jnp.asarray(np.arange(num) < len(checked)),
    )


def distances(
    corners: Array, present: Array, x: Array, y: Array
) -> tuple[Array, tuple[Array, Array]]:
    """Return the signed distances of points from convex polygons, and their gradients.

    Args:
        corners: (N, V, 2) [m], V corners of N polygons, counter-clockwise; may be repeated.
        present: (N,) bool; absent polygons get the distance 1000 m.
        x: (N, P) or (1, P) [m], P points for each polygon, or P points for all polygons.
        y: (N, P) or (1, P) [m].

    Returns:
        distance: (N, P) [m]. Inside a polygon it is minus the distance of the nearest edge's line.
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
        closer = exists & (away < nearest)
        nearest = jnp.where(closer, away, nearest)
        gap_x, gap_y = jnp.where(closer, to_x, gap_x), jnp.where(closer, to_y, gap_y)
        normal_x, normal_y = edge_y * root[:, k, None], -edge_x * root[:, k, None]
        height = from_x * normal_x + from_y * normal_y
        higher = exists & (height > highest)
        highest = jnp.where(higher, height, highest)
        face_x, face_y = jnp.where(higher, normal_x, face_x), jnp.where(higher, normal_y, face_y)
    outside = highest > 0.0
    length = jnp.sqrt(jnp.maximum(nearest, 1e-12))
    distance = jnp.where(outside, length, highest)
    direction = (
        jnp.where(outside, gap_x / length, face_x),
        jnp.where(outside, gap_y / length, face_y),
    )
    return jnp.where(present[:, None], distance, 1e3), direction


def separation(
    corners: Array, present: Array, x: Array, y: Array, heading: Array, body: tuple
) -> Array:
    """Return the gaps [m] between a rectangle at P poses and N polygons, (N, P).

    A gap is the greatest separation along an axis normal to an edge. It is positive if and only if
    rectangle and polygon do not touch (the separating axis theorem), and is at most their distance.

    Args:
        corners: (N, V, 2) [m], V corners of N polygons, counter-clockwise; may be repeated.
        present: (N,) bool; absent polygons get the gap 1000 m.
        x: (N, P) or (1, P) [m], P positions of a reference point on the rectangle's long axis.
        y: (N, P) or (1, P) [m].
        heading: (P,) [rad], direction of the long axis.
        body: coordinates [m] along the long axis of the rectangle's rear and front ends, relative
            to the reference point, and half its width [m].
    """
    behind, ahead, half = body
    cos, sin = jnp.cos(heading)[None], jnp.sin(heading)[None]
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
    return jnp.where(present[:, None], best, 1e3)
