"""Obstacles in the plane from lists of corners, circles and recorded motions."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from planner_jax.core.checks import floating, numbers_of, numeric, shape_of
from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.plane.obstacles import Obstacles, Track
from planner_jax.plane.polygons import Geometry, convex_parts

_COUNTS = (16, 32, 64)  # numbers of entries of `obstacles`; then multiples of the last
_MOST_POSES = 512  # greatest number of steps into which the uneven times of a path are divided
_CORNERS = 8  # least number of corners of an entry of `obstacles`; then its doubles


@dataclasses.dataclass(frozen=True)
class Circle:
    """A circular obstacle, or a part of a moving obstacle.

    Attributes:
        x: [m], x of the middle, in the frame of the polygons in the same list.
        y: [m], y of the middle.
        radius: [m], radius, > 0.
    """

    x: float
    y: float
    radius: float


def obstacles(
    polygons: object,
    velocities: object = 0.0,
    *,
    paths: Sequence[object] | None = None,
    growth: object = 0.0,
    origin: object = (0.0, 0.0),
    dtype: object = jnp.float32,
) -> Obstacles:
    """Make the obstacles of one case from lists of corners.

    The arrays are padded to 16, 32, 64, 128, 192, ... obstacles of 8, 16, 32, 64, ... corners, and
    tables of poses to 16, 32, 64, ... poses. Cases whose arrays have equal sizes share a compiled
    program.

    Args:
        polygons: a sequence with one polygon for each obstacle, at time 0: an array of corners
            (V, 2) [m], in either orientation, a `Circle`, or a geometry of Shapely of the type
            Polygon or MultiPolygon, with or without holes. Each has its own number V of corners. A
            polygon that is not convex becomes several entries, its convex parts, which move alike.
            One geometry alone is one obstacle.
        velocities: (2,) [m/s] for all obstacles, or (N, 2), one for each of N obstacles.
        paths: for each obstacle None, or its recorded motion as a pair (times, poses): increasing
            times (K,) [s], and at these times x [m], y [m] and heading [rad] (K, 3). The corners of
            such an obstacle are in its own frame: relative to x and y, at heading 0. Between two
            times its pose changes linearly, and it exists from the first to the last time only.
        growth: () or (N,) [m/s], >= 0, rate at which each obstacle grows on all sides after time 0,
            because its motion is uncertain.
        origin: (2,) [m], subtracted from all positions in float64.
        dtype: floating type of the arrays.

    Raises:
        TypeError: an argument has a wrong type.
        ValueError: a polygon has no area, or its edges cross; the message names the polygon. Or a
            table of poses has a wrong shape, or its times do not increase.
    """
    dtype = floating(dtype)
    if isinstance(polygons, Geometry):
        polygons = [polygons]
    is_bare = isinstance(polygons, str) or getattr(polygons, "shape", None) == ()
    if is_bare or not isinstance(polygons, Sequence | np.ndarray):
        raise ArgumentTypeError("polygons", "a sequence of polygons", polygons)
    count = len(polygons)
    divided = [_read_polygon(k, polygon) for k, polygon in enumerate(polygons)]
    owner = [k for k, each in enumerate(divided) for _ in each]  # of each part, its obstacle
    parts = [part for each in divided for part in each]
    most = max((len(each) for each in parts), default=3)
    num, size = _pad_count(len(parts)), max(_CORNERS, 1 << (most - 1).bit_length())
    shape = shape_of("velocities", velocities)
    if shape not in ((), (2,), (count, 2)):
        rule = f"the shape (2,) or ({count}, 2)"
        raise ArgumentError("velocities", rule, shape, verb="have")
    require(bool(np.isfinite(np.asarray(velocities)).all()), "velocities", "finite", velocities)
    if (shape := shape_of("growth", growth)) not in ((), (count,)):
        raise ArgumentError("growth", f"the shape () or ({count},)", shape, verb="have")
    require(bool((np.asarray(growth) >= 0.0).all()), "growth", ">= 0", growth)
    given = _check_paths(paths, count)
    tables = [given[k] for k in owner]
    shift = np.asarray(numbers_of("origin", origin, (), (2,)), np.float64)
    centre, velocity = np.zeros((num, 2)), np.zeros((num, 2))
    corners, radius, rates = np.zeros((num, size, 2)), np.zeros(num), np.zeros(num)
    velocity[: len(parts)] = np.broadcast_to(np.asarray(velocities, float), (count, 2))[owner]
    rates[: len(parts)] = np.broadcast_to(np.asarray(growth, float), count)[owner]
    for k, (part, table) in enumerate(zip(parts, tables, strict=True)):
        middle = np.zeros(2) if table is not None else part.mean(axis=0)
        centre[k] = middle - shift
        corners[k] = part[np.minimum(np.arange(size), len(part) - 1)] - middle
        polygon = polygons[owner[k]]
        radius[k] = polygon.radius if isinstance(polygon, Circle) else 0.0
    leaves = (centre, corners, velocity, np.arange(num) < len(parts), radius, rates)
    kinds = [bool if x.dtype == bool else dtype for x in leaves]
    cast = [jnp.asarray(x.astype(kind), kind) for x, kind in zip(leaves, kinds, strict=True)]
    track = None
    if any(table is not None for table in tables):
        rows = _resample(tables, num, centre, velocity, shift)
        track = Track(*(jnp.asarray(row.astype(dtype), dtype) for row in rows))
    return Obstacles(*cast, track=track)


def _pad_count(num: int) -> int:
    return next((size for size in _COUNTS if num <= size), -(-num // _COUNTS[-1]) * _COUNTS[-1])


def _check_paths(
    paths: Sequence[object] | None, count: int
) -> list[tuple[np.ndarray, np.ndarray] | None]:
    if paths is None:
        return [None] * count
    if isinstance(paths, str) or not isinstance(paths, Sequence):
        raise ArgumentTypeError("paths", "a sequence of None or (times, poses)", paths)
    if len(paths) != count:
        raise ArgumentError("paths", f"{count} entries", len(paths), verb="have")
    return [None if path is None else _check_path(k, path) for k, path in enumerate(paths)]


def _check_path(k: int, path: object) -> tuple[np.ndarray, np.ndarray]:
    if not isinstance(path, Sequence) or len(path) != 2:
        raise ArgumentTypeError("paths", "None or a pair (times, poses)", path, k)
    if numeric(path[0]) is None or numeric(path[1]) is None:
        raise ArgumentTypeError("paths", "times and poses of numbers", path, k, verb="have")
    times, poses = np.asarray(path[0], np.float64), np.asarray(path[1], np.float64)
    if times.ndim != 1 or len(times) < 1 or poses.shape != (len(times), 3):
        shown = f"{times.shape} and {poses.shape}"
        rule = "times (K,) and poses (K, 3)"
        raise ArgumentError("paths", rule, index=k, verb="have", shown=shown)
    if not (np.isfinite(times).all() and np.isfinite(poses).all()):
        raise ArgumentError("paths", "finite", index=k, shown="a number that is not")
    if not (np.diff(times) > 0.0).all():
        raise ArgumentError("paths", "increasing times", index=k, verb="have", shown="others")
    return times, poses


def _resample(
    tables: list[tuple[np.ndarray, np.ndarray] | None],
    num: int,
    centre: np.ndarray,
    velocity: np.ndarray,
    shift: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Return the arrays of a `Track`: tables of poses at equal time steps, relative to `shift`.

    Obstacles without a table keep their velocity.
    """
    grids = [None if table is None else _even_times(table[0]) for table in tables]
    horizon = max(1.0, *(table[0][-1] for table in tables if table is not None))
    longest = _pad_count(max(len(grid) for grid in grids if grid is not None))
    poses, begin = np.zeros((num, longest, 3)), np.zeros(num)
    step, end = np.ones(num), np.zeros(num)
    for k, (table, grid) in enumerate(zip(tables, grids, strict=True)):
        if table is None or grid is None:  # a straight motion, which goes on after the horizon
            far = 100.0 * horizon if velocity[k].any() else 1e6 * horizon
            begin[k], step[k], end[k] = 0.0, far / (longest - 1), far
            poses[k, :, :2] = centre[k] + velocity[k] * (step[k] * np.arange(longest))[:, None]
            continue
        times, rows = table
        rows = np.column_stack([rows[:, :2] - shift, np.unwrap(rows[:, 2])])
        sampled = np.stack([np.interp(grid, times, row) for row in rows.T], axis=1)
        poses[k] = sampled[np.minimum(np.arange(longest), len(grid) - 1)]
        begin[k], end[k] = grid[0], times[-1]
        step[k] = grid[1] - grid[0] if len(grid) > 1 else 1.0
    return poses, begin, step, end


def _even_times(times: np.ndarray) -> np.ndarray:
    """Return equally spaced times that include the given times, or nearly so if they are many."""
    if len(times) < 2:
        return times
    steps = np.diff(times)
    num = round((times[-1] - times[0]) / steps.min())
    return np.linspace(times[0], times[-1], min(num, max(_MOST_POSES, len(times))) + 1)


def _read_polygon(k: int, polygon: object) -> list[np.ndarray]:
    """Return the convex parts of the polygon with the index k; a circle has one corner."""
    if not isinstance(polygon, Circle):
        return convex_parts("polygons", polygon, k)
    if not np.isfinite([polygon.x, polygon.y]).all():
        raise ArgumentError("polygons", "finite", polygon, k)
    if not 0.0 < polygon.radius < np.inf:
        raise ArgumentError("polygons", "a radius > 0", polygon.radius, k, verb="have")
    return [np.array([[polygon.x, polygon.y]], float)]
