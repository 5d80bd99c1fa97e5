"""Paths that a search has found, made smooth by gradient descent [Qu2022, Section III-C].

Points of the path move, its ends stay. The cost (eq. 12) keeps them away from obstacles (eq. 13),
within the curvature's limit (eq. 14) and evenly spaced on a line as straight as may be (eq. 15).
What is printed does not work as it stands; here

* J_obs counts only points nearer than d_max, as the text says; eq. 13 would also draw the others
  to that distance;
* J_cur counts only what is above kappa_max, squared; eq. 14 sums the difference itself, which has
  no least value and weighs the same everywhere. Delta phi is the angle between two displacements,
  where the difference of two arctangents jumps;
* alpha_1, alpha_2, alpha_3 of eq. 16 are the one step alpha by the weights of eq. 12, which the
  experiments name;
* lengths are measured in the mean distance of neighbouring points, near the pixels of the paper's
  map: J_cur is the only term whose scale depends on the unit, and in metres the step makes it
  diverge. A step that would raise the cost is halved instead;
* the first two points and the last two are held, as the car's heading there is given.

The points are the control points of a cubic B-spline, which has headings and a continuous
curvature: at a knot it is nearly that of three points, which J_cur looks at. None of the terms is
a strict limit, so a smooth path may be bent too much, often where a wall near an end pushes the
points beside those that are held. Points part of the way from the given path are tried then, and
in the end the given path is kept. A path as tight as the limit all along leaves no room: search
with nine tenths of it. World frame in the plane, SI units.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.errors import ArgumentError
from planner_jax.plane.obstacles import Obstacles, distances, separation

_FINE = 8  # samples of a piece of the spline, for its length
# Of the way from given points to smooth ones, what is tried; at 0 the spline alone smooths.
_SHARES = (1.0, 0.5, 0.25, 0.0)
# Relative, for rounding: searched arcs are just as tight as allowed.
_CURVATURE_ROOM = 1e-3


@dataclasses.dataclass(frozen=True)
class Smoothing:
    """Weights and step of [Qu2022, Section V-C], and what else shapes the program."""

    obstacle: float = 0.1
    curvature: float = 0.1
    smoothness: float = 0.2
    step: float = 0.25
    reach: float = 0.5  # [m], d_max, from which on obstacles do not matter; not in the paper
    iterations: int = 100
    stride: int = 4  # every how many poses one is a point that moves
    margin: float = 0.01  # [m], that the body keeps from walls between poses


@struct.dataclass
class SmoothPath:
    """A path with N poses at equal distances, of one case or of a batch."""

    poses: Array  # (N, 3) x, y [m] of the rear axle and heading [rad], not wrapped
    curvature: Array  # (N,) [1/m]
    length: Array  # () [m]
    is_smooth: Array  # () bool; False where the given path was kept
    share: Array  # (), of the way from the given points to smooth ones; 0 where it was kept


def smooth_path(
    poses: Array,
    bends: Array,
    length: Array,
    walls: Obstacles,
    *,
    curvature: Array,
    body: tuple,
    lower: Array,
    upper: Array,
    settings: Smoothing = Smoothing(),
) -> SmoothPath:
    """A path made smooth, or as it is if it then were in a wall, off the map or bent too much.

    Pure, for one case; `vmap` it for many.

    Args:
        poses: (N, 3) at equal distances, N - 1 a multiple of the stride.
        bends: (N,) [1/m], curvature there.
        length: () [m], of the given path.
        walls: that stand.
        curvature: () [1/m], > 0, the tightest.
        body: ends of the body behind and ahead of the rear axle, and half its width [m].
        lower: (2,) [m], corner of the map, which the body's middle does not leave.
        upper: (2,) [m], opposite corner.
        settings: weights and sizes.

    Raises:
        ValueError: the number of poses does not fit the stride, or is too small.
    """
    pieces, rest = divmod(poses.shape[0] - 1, settings.stride)
    if rest or pieces < 4:
        raise ArgumentError(
            "poses", f"{settings.stride} k + 1, k >= 4, for this stride", poses.shape[0]
        )
    given = control_points(poses[:: settings.stride], bends[:: settings.stride])
    smooth = smooth_points(given, walls, curvature, settings)
    corners = walls.vertices(jnp.zeros_like(length))
    middle = 0.5 * (body[0] + body[1])

    def tried(share: Array) -> tuple[Array, Array, Array, Array]:
        """A path and whether it is a good one."""
        points = given + share * (smooth - given)
        found, bent, total = resampled(points, poses[0, 2], poses[-1, 2], poses.shape[0])
        x, y, heading = found.T
        gap = separation(corners, walls.present, x[None], y[None], heading, body)
        ahead = jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=1)
        place = found[:, :2] + middle * ahead
        good = jnp.all(gap >= settings.margin) & jnp.all((place >= lower) & (place <= upper))
        good &= jnp.all(jnp.abs(bent) <= curvature * (1.0 + _CURVATURE_ROOM))
        return found, bent, total, good

    shares = jnp.asarray(_SHARES, poses.dtype)
    *paths, good = jax.vmap(tried)(shares)
    first, is_smooth = jnp.argmax(good), jnp.any(good)
    found, bent, total = (
        jnp.where(is_smooth, path[first], kept)
        for path, kept in zip(paths, (poses, bends, length), strict=True)
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
    """Points (n + 1, 2) [m] after gradient descent [Qu2022, eq. 16]; the ends stay.

    Args:
        points: (n + 1, 2) [m], about equally far apart, such as `control_points`.
        walls: that stand.
        curvature: () [1/m], the tightest.
        settings: weights and sizes.
    """
    unit = _mean_distance(points)
    moves = (np.arange(len(points)) >= 2) & (np.arange(len(points)) < len(points) - 2)

    def cost(points: Array) -> Array:
        return smoothing_cost(points, unit, walls, curvature, settings)

    value_and_slope = jax.value_and_grad(cost)

    def descend(state: tuple, _: None) -> tuple[tuple, None]:
        points, value, slope, step = state
        # The cost is of lengths in units: its slope by them is `unit` times that by metres.
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
    """J_G of [Qu2022, eq. 12], () without unit; see the top of the module for its terms.

    Args:
        points: (n + 1, 2) [m].
        unit: () [m], in which lengths are measured.
        walls: that stand.
        curvature: () [1/m], kappa_max.
        settings: weights and reach.
    """
    steps = (points[1:] - points[:-1]) / unit
    before, after = steps[:-1], steps[1:]
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    turn = jnp.abs(jnp.arctan2(cross, jnp.sum(before * after, axis=1)))
    excess = turn / jnp.linalg.norm(before, axis=1) - curvature * unit
    close = (settings.reach - _nearest(points, walls)) / unit
    return (
        settings.obstacle * jnp.sum(jnp.maximum(close, 0.0) ** 2)
        + settings.curvature * jnp.sum(jnp.maximum(excess, 0.0) ** 2)
        + settings.smoothness * jnp.sum((after - before) ** 2)
    )


def control_points(poses: Array, bends: Array) -> Array:
    """Control points (n + 1, 2) [m] of a B-spline that runs close to poses (n + 1, 3).

    The spline cuts corners by a sixth of how far three points are off a line; inner points are
    moved by as much, and those beside the ends so that the curvatures there are the given ones.

    Args:
        poses: (n + 1, 3), about equally far apart.
        bends: (n + 1,) [1/m], curvature there.
    """
    points = poses[:, :2]
    step = _mean_distance(points)
    inner = points[1:-1] - (points[2:] - 2.0 * points[1:-1] + points[:-2]) / 6.0

    def beside(pose: Array, bend: Array, step: Array) -> Array:
        ahead = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
        left = jnp.stack([-ahead[1], ahead[0]])
        return pose[:2] + step * ahead + (bend * step**2 / 3.0) * left

    first, last = beside(poses[0], bends[0], step), beside(poses[-1], bends[-1], -step)
    return jnp.concatenate([points[:1], first[None], inner[1:-1], last[None], points[-1:]])


def resampled(
    points: Array, start_heading: Array, end_heading: Array, num: int
) -> tuple[Array, Array, Array]:
    """Poses at equal distances along the B-spline of control points.

    It begins and ends where they do, with the given headings.

    Args:
        points: (n + 1, 2) [m], about equally far apart.
        start_heading: () [rad].
        end_heading: () [rad], to a multiple of a turn.
        num: N, how many poses.

    Returns:
        poses: (N, 3), the first heading the given one, the others continuous from it.
        curvature: (N,) [1/m].
        length: () [m].
    """
    pieces = points.shape[0] - 1
    control = _clamped(points, start_heading, end_heading)
    places = jnp.linspace(0.0, pieces, pieces * _FINE + 1, dtype=points.dtype)
    # Simpson's rule on every pair of half steps.
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


def _clamped(points: Array, start_heading: Array, end_heading: Array) -> Array:
    """Control points with the two beyond the ends (n + 3, 2), so that the ends are met.

    The first and the last one are moved, so that the spline begins and ends where they were.
    """

    def end(at: Array, beside: Array, heading: Array) -> tuple[Array, Array]:
        step = jnp.linalg.norm(beside - at) * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
        return 1.5 * at - 0.5 * beside + 0.5 * step, beside - 2.0 * step

    first, before = end(points[0], points[1], start_heading)
    last, after = end(points[-1], points[-2], end_heading + np.pi)
    return jnp.concatenate([before[None], first[None], points[1:-1], last[None], after[None]])


def _mean_distance(points: Array) -> Array:
    """Mean distance () [m] of neighbouring points."""
    return jnp.mean(jnp.linalg.norm(points[1:] - points[:-1], axis=1))


def _nearest(points: Array, walls: Obstacles) -> Array:
    """Distance (n,) [m] of points from the nearest wall; its slope is known without more work."""
    fixed = lax.stop_gradient(points)
    x, y = fixed.T
    far, away = distances(walls.vertices(jnp.zeros_like(x[0])), walls.present, x[None], y[None])
    nearest = jnp.argmin(far, axis=0)[None]
    far, *away = (jnp.take_along_axis(each, nearest, axis=0)[0] for each in (far, *away))
    return far + jnp.sum(jnp.stack(away, axis=1) * (points - fixed), axis=1)


def _spline(control: Array, place: Array) -> tuple[Array, Array, Array]:
    """Positions (M, 2) of a uniform cubic B-spline and their first two derivatives.

    Args:
        control: (n + 3, 2), of which each belongs to a knot, the first one to knot -1.
        place: (M,), counted in knots, from 0 to n.
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
