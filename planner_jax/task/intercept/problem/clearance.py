"""Geometry of an interception: distances of the car from obstacles, map's edge and target."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.plane.obstacles import Obstacles, distances, join_obstacles, place, separation
from planner_jax.plane.target import rotate
from planner_jax.robot.car import CarBody
from planner_jax.robot.car_motion import Motion
from planner_jax.task.intercept.case import InterceptCase

_CHUNK = 16  # number of walls whose distances from the body are computed together


def wrap(angle: Array) -> Array:
    """Return an angle [rad] plus the multiple of 2 pi that brings it between -pi and pi."""
    return angle - 2.0 * np.pi * jnp.round(angle / (2.0 * np.pi))


def discs_of(body: CarBody, num: int) -> tuple[Array, Array]:
    """Cover the car's body by `num` discs; return radius, and positions from the rear axle [m]."""
    half = 0.5 * body.length / num
    radius = jnp.sqrt(half**2 + (0.5 * body.width) ** 2)
    steps = np.arange(1 - num, num, 2)
    return radius, body.middle + half * jnp.asarray(steps, body.length.dtype)


def ends_of(body: CarBody) -> tuple[Array, Array, Array]:
    """Return positions of the body's ends ahead of the rear axle, and half its width, () [m]."""
    return -body.rear_overhang, body.length - body.rear_overhang, 0.5 * body.width


def clearance(case: InterceptCase, drive: Motion) -> Array:
    """Return the body's least clearance () [m] from obstacles and the map's edge.

    The clearance from obstacles is reduced by the margin of the case. It includes the motion
    between the samples, by the bound of `least_between`.
    """
    pos, heading = drive.pos.reshape(-1, 2), drive.heading.reshape(-1)
    middle = pos + case.body.middle * drive.direction.reshape(-1, 2)
    least_of = lambda gaps: jnp.min(least_between(gaps))  # noqa: E731
    apart = least_gap(case, pos, heading, drive.time.reshape(-1), least_of) - case.margin
    return jnp.minimum(jnp.min(inside_map(case, middle)), apart)


def least_between(gaps: Array) -> Array:
    """Return lower bounds (N,) of N convex functions, from M equally spaced values (N, M) of each.

    The gap of two convex polygons in relative motion along a straight line is a convex function of
    time. Between two samples it is above two straight lines: through the two samples before, and
    through the two samples after. The motion is almost straight over four samples. The bound needs
    no distance that would depend on the size of the car.
    """
    fall, rise = gaps[:, 1:-2] - gaps[:, :-3], gaps[:, 3:] - gaps[:, 2:-1]
    left, right = gaps[:, 1:-2], gaps[:, 2:-1]
    is_dip = (fall < 0.0) & (rise > 0.0)
    share = (left - right + rise) / jnp.where(is_dip, rise - fall, 1.0)
    dip = jnp.where(is_dip, left + jnp.clip(share, 0.0, 1.0) * fall, jnp.inf)
    return jnp.minimum(jnp.min(gaps, axis=1), jnp.min(dip, axis=1))


def least_gap(
    case: InterceptCase,
    pos: Array,
    heading: Array,
    times: Array,
    least_of: Callable[[Array], Array] = jnp.min,
) -> Array:
    """Return the least gap () [m] between the obstacles and the body at M poses.

    Args:
        case: the case, with its walls and moving obstacles.
        pos: (M, 2) [m], positions of the rear axle.
        heading: (M,) [rad].
        times: (M,) [s].
        least_of: function that returns the least gap () of N obstacles from their gaps (N, M).
    """

    def measure(group: Obstacles) -> Array:
        placed = place(group, times)
        x, y = placed.enter(pos[None, :, 0], pos[None, :, 1])
        angle = heading[None] - (0.0 if placed.turn is None else jnp.arctan2(*placed.turn[1::-1]))
        apart = separation(group.corners, placed.present, x, y, angle, ends_of(case.body))
        return least_of(apart - placed.radius)

    walls, movers = case.walls, case.movers
    num = walls.present.shape[0]
    if num <= _CHUNK or num % _CHUNK or not movers.present.shape[0]:
        return measure(join_obstacles(walls, movers))

    # On a CPU chunks of absent walls, which are padding, take no time.
    def measure_present(chunk: Obstacles) -> Array:
        absent = jnp.full((), 1e3, pos.dtype)
        return lax.cond(jnp.any(chunk.present), measure, lambda _: absent, chunk)

    chunks = jax.tree.map(lambda leaf: leaf.reshape(-1, _CHUNK, *leaf.shape[1:]), walls)
    return jnp.minimum(jnp.min(lax.map(measure_present, chunks)), measure(movers))


def inside_map(case: InterceptCase, points: Array) -> Array:
    """Return the distances (...) [m] of points (..., 2) from the map's edge, negative off the map.

    They are infinite if the map is unbounded.
    """
    at = rotate(points, -case.map_heading)
    lower, upper = (jnp.broadcast_to(each, at.shape) for each in (case.lower, case.upper))
    return jnp.min(jnp.minimum(at - lower, upper - at), axis=-1)


def is_blocked(case: InterceptCase) -> tuple[Array, Array]:
    """Return whether the car is blocked at the start, and whether the target is blocked, () bool.

    The car is blocked if it overlaps an obstacle or is off the map. The target is blocked if at the
    meeting time it is off the map, or nearer to an obstacle than half the car's width.
    """
    goal = case.target.at(case.time).pos
    first = jnp.zeros_like(case.time)[None]
    at_start = least_gap(case, case.start[None, :2], case.start[2:], first)
    is_off = inside_map(case, case.body.middle_at(case.start)) < 0.0
    both = join_obstacles(case.walls, case.movers)
    placed = place(both, case.time[None])
    local = placed.enter(goal[None, None, 0], goal[None, None, 1])
    at_goal = distances(both.corners, placed.present, *local)[0] - placed.radius
    # A part of a region around the target may be free even if the target itself is blocked.
    is_point = jnp.all(case.region == 0.0)
    is_near = jnp.min(at_goal) < 0.5 * case.body.width
    is_goal_blocked = is_point & (is_near | (inside_map(case, goal) <= 0.0))
    return (at_start < 0.0) | is_off, is_goal_blocked


def nearest_in_region(region: Array, point: Array) -> tuple[Array, Array]:
    """Return the vector to a point () from the nearest point of a convex region, and its slope.

    Args:
        region: (V, 2) [m], corners of the region, counter-clockwise; all equal: a point.
        point: (2,) [m].

    Returns:
        away: (2,) [m], zero if the point is in the region.
        slope: (2, 2), derivative of `away` by the point.
    """
    before = jnp.roll(region, 1, axis=0)
    edge = region - before
    square = jnp.sum(edge**2, axis=1)
    is_edge = square > 1e-10
    from_corner = point[None] - before
    along = jnp.sum(from_corner * edge, axis=1) / jnp.where(is_edge, square, 1.0)
    share = jnp.clip(jnp.where(is_edge, along, 0.0), 0.0, 1.0)
    away = from_corner - share[:, None] * edge
    nearest = jnp.argmin(jnp.sum(away**2, axis=1))
    outward = edge[:, 1] * from_corner[:, 0] - edge[:, 0] * from_corner[:, 1]
    is_outside = jnp.any(is_edge & (outward > 0.0)) | ~jnp.any(is_edge)
    is_on_edge = is_edge[nearest] & (along[nearest] > 0.0) & (along[nearest] < 1.0)
    normal = jnp.stack([edge[nearest, 1], -edge[nearest, 0]])
    normal = normal / jnp.sqrt(jnp.where(is_edge[nearest], square[nearest], 1.0))
    eye = jnp.eye(2, dtype=point.dtype)
    slope = jnp.where(is_on_edge, normal[:, None] * normal[None], eye)
    return jnp.where(is_outside, away[nearest], 0.0), jnp.where(is_outside, slope, 0.0)
