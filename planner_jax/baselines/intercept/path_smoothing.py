"""Smoothing of a car's searched paths by gradient descent [Qu2022, Section III-C].

Gradient descent moves the inner points of the path. The cost (eq. 12) keeps them away from
obstacles (eq. 13), within the curvature limit (eq. 14) and evenly spaced on a line that is as
straight as possible (eq. 15). The equations as printed do not work. These are the changes:

* The obstacle cost counts only points nearer than a distance d_max, as the paper's text says.
  Eq. 13 would also attract farther points to that distance.
* The curvature cost is the squared excess of the curvature over its limit. Eq. 14 sums the
  difference itself, which has no minimum. The change of heading is the angle between two steps of
  the path; the paper's difference of two arctangents has jumps.
* The three step sizes of eq. 16 are a single step size times the weights of eq. 12, as in the
  paper's experiments.
* The unit of length is the mean distance of neighbouring points, since the paper uses pixels of its
  map; in metres the descent diverges. A step that would increase the cost is halved.
* The first two and the last two points are fixed, since the car's heading at the ends is given.

The points are the control points of a cubic B-spline, whose curvature is continuous. A smooth path
may still exceed the curvature limit, since the limit is only a term of the cost. Points between
the given and the smooth path are then tried, and at last the given path is returned. A given path
at the curvature limit leaves no freedom; the caller should search with nine tenths of the limit.
Positions are in the world frame in the plane, in SI units.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.errors import ArgumentError
from planner_jax.penalties.paths import curvature_cost, obstacle_cost, smoothness_cost
from planner_jax.plane.obstacles import Obstacles, distances, separation

_FINE = 8  # number of samples per piece of the spline, for the computation of its length
# Fractions of the shift from given to smoothed points, tried until a path keeps all limits.
_SHARES = (1.0, 0.5, 0.25, 0.0)
# Relative excess over the curvature limit that is allowed, because of rounding errors.
_CURVATURE_TOLERANCE = 1e-3


@dataclasses.dataclass(frozen=True)
class Smoothing:
    """Weights, step size and number of iterations of gradient descent [Qu2022, Section V-B]."""

    obstacle: float = 0.1  # weight of the cost of obstacles
    curvature: float = 0.1  # weight of the cost of curvature above the limit
    smoothness: float = 0.2  # weight of the squared differences of neighbouring steps
    step: float = 0.25  # initial step size of gradient descent
    reach: float = 0.5  # [m], only points nearer to an obstacle than this distance have a cost
    iterations: int = 100  # number of gradient steps
    stride: int = 4  # number of poses of the given path from one moving point to the next
    margin: float = 0.01  # [m], least distance from walls, since only poses are checked


@struct.dataclass
class SmoothPath:
    """A path with N poses at equal distances, of one case or of a batch."""

    poses: Array  # (N, 3) x, y [m] of the rear axle, heading [rad] without jumps of 2 pi
    curvature: Array  # (N,) [1/m]
    length: Array  # () [m]
    is_smooth: Array  # () bool; False if the given path is returned unchanged
    share: Array  # (), fraction of the shift from given to smooth points; 0 if not smooth


def smooth_path(
    poses: Array,
    curvatures: Array,
    length: Array,
    walls: Obstacles,
    *,
    curvature: Array,
    body: tuple,
    lower: Array,
    upper: Array,
    settings: Smoothing = Smoothing(),
) -> SmoothPath:
    """Smooth a path; return it unchanged if every smooth path would break a limit.

    A path breaks a limit if it touches a wall, leaves the map, or exceeds the greatest curvature.

    Args:
        poses: (N, 3) x, y [m] and heading [rad], at equal distances. Every `settings.stride`-th
            pose becomes a control point of the smooth path.
        curvatures: (N,) [1/m], curvature at the poses.
        length: () [m], length of the given path.
        walls: standing obstacles.
        curvature: () [1/m], > 0, greatest curvature.
        body: [m], distances of the body's rear (negative) and front end ahead of the rear axle, and
            half of its width.
        lower: (2,) [m], least coordinates of the map, in which the body's centre must stay.
        upper: (2,) [m], greatest coordinates of the map.
        settings: weights, step size and number of iterations.

    Raises:
        ArgumentError: N - 1 is not a multiple of the stride, or there are fewer than five control
            points: the first two and the last two are fixed.
    """
    pieces, rest = divmod(poses.shape[0] - 1, settings.stride)
    if rest or pieces < 4:
        raise ArgumentError(
            "poses", f"{settings.stride} k + 1, k >= 4, for this stride", poses.shape[0]
        )
    given = control_points(poses[:: settings.stride], curvatures[:: settings.stride])
    smooth = smooth_points(given, walls, curvature, settings)
    corners = walls.vertices(jnp.zeros_like(length))
    middle = 0.5 * (body[0] + body[1])

    def evaluate(share: Array) -> tuple[Array, Array, Array, Array]:
        points = given + share * (smooth - given)
        found, bent, total = resample(points, poses[0, 2], poses[-1, 2], poses.shape[0])
        x, y, heading = found.T
        gap = separation(corners, walls.present, x[None], y[None], heading, body)
        ahead = jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=1)
        place = found[:, :2] + middle * ahead
        good = jnp.all(gap >= settings.margin) & jnp.all((place >= lower) & (place <= upper))
        good &= jnp.all(jnp.abs(bent) <= curvature * (1.0 + _CURVATURE_TOLERANCE))
        return found, bent, total, good

    shares = jnp.asarray(_SHARES, poses.dtype)
    *paths, good = jax.vmap(evaluate)(shares)
    first, is_smooth = jnp.argmax(good), jnp.any(good)
    found, bent, total = (
        jnp.where(is_smooth, path[first], kept)
        for path, kept in zip(paths, (poses, curvatures, length), strict=True)
    )
    return SmoothPath(
        poses=found,
        curvature=bent,
        length=total,
        is_smooth=is_smooth,
        share=jnp.where(is_smooth, shares[first], 0.0),
    )


def smooth_points(
    points: Array, walls: Obstacles, curvature: Array, settings: Smoothing = Smoothing()
) -> Array:
    """Return the points (n + 1, 2) [m] after gradient descent on the cost [Qu2022, eq. 16].

    Args:
        points: (n + 1, 2) [m], nearly equally spaced control points of the path.
        walls: standing obstacles.
        curvature: () [1/m], greatest curvature.
        settings: weights, step size and number of iterations.
    """
    unit = _mean_distance(points)
    moves = (np.arange(len(points)) >= 2) & (np.arange(len(points)) < len(points) - 2)

    def cost(points: Array) -> Array:
        return smoothing_cost(points, unit, walls, curvature, settings)

    value_and_slope = jax.value_and_grad(cost)

    def descend(state: tuple, _: None) -> tuple[tuple, None]:
        points, value, slope, step = state
        # The cost's unit of length is `unit` [m]. The gradient in this unit is unit * slope, and
        # the step is converted to metres by another factor `unit`.
        moved = points - jnp.where(moves[:, None], step * unit**2 * slope, 0.0)
        new = (moved, *value_and_slope(moved))
        is_lower = new[1] <= value
        kept = jax.tree.map(lambda a, b: jnp.where(is_lower, a, b), new, (points, value, slope))
        return (*kept, jnp.where(is_lower, step, 0.5 * step)), None

    start = (points, *value_and_slope(points), jnp.asarray(settings.step, points.dtype))
    (points, *_), _ = lax.scan(descend, start, None, length=settings.iterations)
    return points


def smoothing_cost(
    points: Array,
    unit: Array,
    walls: Obstacles,
    curvature: Array,
    settings: Smoothing = Smoothing(),
) -> Array:
    """Return the cost () of a path: obstacles, curvature and smoothness [Qu2022, eq. 12].

    Args:
        points: (n + 1, 2) [m], points of the path.
        unit: () [m], unit of length in which the cost is computed.
        walls: standing obstacles.
        curvature: () [1/m], greatest curvature.
        settings: weights, and `reach` [m], the distance up to which obstacles add to the cost.
    """
    return (
        settings.obstacle * obstacle_cost(_nearest(points, walls), settings.reach, unit)
        + settings.curvature * curvature_cost(points, curvature, unit)
        + settings.smoothness * smoothness_cost(points, unit)
    )


def control_points(poses: Array, curvatures: Array) -> Array:
    """Return control points (n + 1, 2) [m] of a cubic B-spline close to n + 1 poses.

    A cubic B-spline deviates from a control point by a sixth of the second difference of the points
    around it. Inner points are shifted to compensate for this deviation. The points next to the
    ends are placed so that the spline has the given curvature at its ends.

    Args:
        poses: (n + 1, 3), x, y [m] and heading [rad], nearly equally spaced.
        curvatures: (n + 1,) [1/m], curvature at the poses.
    """
    points = poses[:, :2]
    step = _mean_distance(points)
    inner = points[1:-1] - (points[2:] - 2.0 * points[1:-1] + points[:-2]) / 6.0

    def beside(pose: Array, bend: Array, step: Array) -> Array:
        ahead = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
        left = jnp.stack([-ahead[1], ahead[0]])
        return pose[:2] + step * ahead + (bend * step**2 / 3.0) * left

    first, last = beside(poses[0], curvatures[0], step), beside(poses[-1], curvatures[-1], -step)
    return jnp.concatenate([points[:1], first[None], inner[1:-1], last[None], points[-1:]])


def resample(
    points: Array, start_heading: Array, end_heading: Array, num: int
) -> tuple[Array, Array, Array]:
    """Sample poses at equal distances along the B-spline of control points.

    The spline starts and ends at the first and last control point, with the given headings.

    Args:
        points: (n + 1, 2) [m], nearly equally spaced control points.
        start_heading: () [rad].
        end_heading: () [rad]; full turns make no difference.
        num: number of poses.

    Returns:
        poses: (num, 3), x, y [m] and heading [rad], which starts at `start_heading` and has no
            jumps.
        curvature: (num,) [1/m], curvature at the poses.
        length: () [m], length of the path.
    """
    pieces = points.shape[0] - 1
    control = _clamp_ends(points, start_heading, end_heading)
    places = jnp.linspace(0.0, pieces, pieces * _FINE + 1, dtype=points.dtype)
    # Lengths of the spline's intervals by Simpson's rule, with their midpoints as middle nodes.
    half = 0.5 / _FINE
    speed, between = (
        jnp.linalg.norm(_spline(control, at)[1], axis=1) for at in (places, places[:-1] + half)
    )
    rises = (speed[:-1] + 4.0 * between + speed[1:]) * (half / 3.0)
    stations = jnp.concatenate([jnp.zeros_like(rises[:1]), jnp.cumsum(rises)])
    wanted = jnp.linspace(0.0, 1.0, num, dtype=points.dtype) * stations[-1]
    pos, first, second = _spline(control, jnp.interp(wanted, stations, places))
    square = jnp.sum(first**2, axis=1)
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    heading = jnp.unwrap(jnp.arctan2(first[:, 1], first[:, 0]))
    heading = heading + (start_heading - heading[0])
    poses = jnp.concatenate([pos, heading[:, None]], axis=1)
    return poses, cross / (square * jnp.sqrt(square)), stations[-1]


def _clamp_ends(points: Array, start_heading: Array, end_heading: Array) -> Array:
    """Add a control point before the first and after the last, for the headings [rad] at both ends.

    The first and the last control point are shifted, so that the spline starts and ends at their
    original positions.
    """

    def end(at: Array, beside: Array, heading: Array) -> tuple[Array, Array]:
        step = jnp.linalg.norm(beside - at) * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
        return 1.5 * at - 0.5 * beside + 0.5 * step, beside - 2.0 * step

    first, before = end(points[0], points[1], start_heading)
    last, after = end(points[-1], points[-2], end_heading + np.pi)
    return jnp.concatenate([before[None], first[None], points[1:-1], last[None], after[None]])


def _mean_distance(points: Array) -> Array:
    return jnp.mean(jnp.linalg.norm(points[1:] - points[:-1], axis=1))


def _nearest(points: Array, walls: Obstacles) -> Array:
    """Return the distances (n,) [m] of n points from their nearest walls.

    The gradient of a distance is the unit vector away from the nearest wall.
    """
    fixed = lax.stop_gradient(points)
    x, y = fixed.T
    far, away = distances(walls.vertices(jnp.zeros_like(x[0])), walls.present, x[None], y[None])
    nearest = jnp.argmin(far, axis=0)[None]
    far, *away = (jnp.take_along_axis(each, nearest, axis=0)[0] for each in (far, *away))
    return far + jnp.sum(jnp.stack(away, axis=1) * (points - fixed), axis=1)


def _spline(control: Array, place: Array) -> tuple[Array, Array, Array]:
    """Evaluate positions (M, 2) of a uniform cubic B-spline and their first two derivatives.

    Args:
        control: (n + 3, 2), control points of the knots -1, 0, ..., n + 1.
        place: (M,), positions on the spline from 0 to n; knot k is at position k.
    """
    k = jnp.clip(place.astype(jnp.int32), 0, control.shape[0] - 4)
    u = (place - k)[:, None]
    a, b, c, d = (control[k + i] for i in range(4))
    v = 1.0 - u
    near, far = (3.0 * u - 6.0) * u * u + 4.0, (3.0 * v - 6.0) * v * v + 4.0
    return (
        (v**3 * a + near * b + far * c + u**3 * d) / 6.0,
        0.5 * (v * v * (b - a) + (1.0 + 2.0 * u * v) * (c - b) + u * u * (d - c)),
        v * (c - 2.0 * b + a) + u * (d - 2.0 * c + b),
    )
