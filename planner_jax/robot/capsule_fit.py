"""Capsules and boxes that enclose convex bodies and are hardly larger, and hulls of meshes."""

import functools
import importlib
import itertools
import math
import os
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError

from planner_jax.core.errors import ArgumentError
from planner_jax.host.files import read_plain

LARGEST_MESH = 1 << 25  # [B], of a file
# [m]: one more capsule is used if it reduces the mean excess by at least this length.
_WORTH = 0.002
_ROUNDING = 1e-6  # [m], added to fitted radii, so that capsules in float32 enclose the body too


class Cover(NamedTuple):
    """Capsules that enclose a body, and by how much they exceed it."""

    ends: np.ndarray  # (K, 2, 3) [m], ends of the capsules' axes
    radius: np.ndarray  # (K,) [m]
    greatest: float = 0.0  # [m], greatest distance of a point of the capsules from the body
    mean: float = 0.0  # [m], mean over all directions of how much farther the capsules reach


def cover(points: np.ndarray, most: int = 3) -> Cover:
    """Enclose the convex hull of points (V, 3) [m] by one to `most` capsules.

    Planes across the longest principal axis, or another axis that is almost as long, cut the hull
    into slabs of equal thickness. Each slab gets the capsule of least mean width that contains the
    slab's corners. A capsule is convex, so that it contains the whole slab. Covers are cached.
    """
    return _cover(np.ascontiguousarray(points, float).tobytes(), most)


@functools.lru_cache(maxsize=256)
def _cover(content: bytes, most: int) -> Cover:
    points = np.frombuffer(content).reshape(-1, 3)
    hull = ConvexHull(points, qhull_options="QJ")
    sides = hull.simplices[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = points[np.unique(np.sort(sides, axis=1), axis=0)]
    corners = points[hull.vertices]
    axes = _principal_axes(corners)
    sizes = np.ptp(corners @ axes.T, axis=0)
    long = axes[sizes > 0.7 * np.max(sizes)][:2]
    cuts = [[corners]]
    cuts += [_slabs(edges, axis, k) for k, axis in itertools.product(range(2, most + 1), long)]
    covers = []
    for pieces in cuts:
        ends, radius = zip(*map(_enclose, pieces), strict=True)
        fitted = np.stack(ends), np.array(radius)
        covers.append(Cover(*fitted, *measure_excess(*fitted, corners)))
    return min(covers, key=lambda each: each.mean + _WORTH * len(each.radius))


def enclosing_box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return middle (3,) [m], rotation (3, 3) and half edges (3,) [m] of a box around V points.

    The rotation maps the frame of the box to the frame of the points (V, 3) [m]. The edges are
    parallel to the coordinate axes or to the principal axes of the points, whichever edges are
    shorter.
    """
    boxes = []
    for axes in (np.eye(3), _principal_axes(points)):
        axes = axes * np.linalg.det(axes)  # right-handed
        low, high = np.min(points @ axes.T, axis=0), np.max(points @ axes.T, axis=0)
        boxes.append((0.5 * (low + high) @ axes, axes.T, 0.5 * (high - low) + _ROUNDING))
    return min(boxes, key=lambda box: np.sum(box[2]))


def hull_of(mesh: str | os.PathLike | ArrayLike, scale: float, name: str) -> np.ndarray:
    """Return the corners (V, 3) [m] of the convex hull of a mesh.

    The mesh is a binary STL, OBJ or MSH file, which MuJoCo reads, or points (N, 3). Its unit of
    length is `scale` [m]. An `ArgumentError` calls the mesh `name`.
    """
    points, shown, head = mesh, "", b""
    try:
        if isinstance(mesh, str | os.PathLike):
            shown = f"{os.fspath(mesh)}: "
            head = read_plain(mesh, LARGEST_MESH)[:5]  # the compiler would wait for a pipe's writer
            mujoco: Any = importlib.import_module("mujoco")  # slow to import
            spec, turn = mujoco.MjSpec(), np.zeros(9)
            read = spec.add_mesh(name="mesh", file=os.fspath(mesh))
            read.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            model = spec.compile()
            mujoco.mju_quat2Mat(turn, model.mesh_quat[0])  # MuJoCo moves a mesh to its centre
            points = model.mesh_vert @ turn.reshape(3, 3).T + model.mesh_pos[0]
        points = scale * np.reshape(np.asarray(points, float), (-1, 3))
        return points[ConvexHull(points).vertices]
    except (OSError, TypeError, ValueError, QhullError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        reason = reason.removeprefix("Error: ").partition("\n")[0]
        if head == b"solid":
            reason = f"{reason}; an STL file of text is not read, convert it to a binary one"
        rule = "a binary STL, OBJ or MSH file of a mesh with a volume; correct the path or the mesh"
        raise ArgumentError(name, rule, shown=shown + reason) from None


def measure_excess(ends: np.ndarray, radius: np.ndarray, points: np.ndarray) -> tuple[float, float]:
    """Return the greatest and the mean excess [m] of K capsules around the hull of points (V, 3).

    The support function h(u) is the greatest u . p of the points p of a body, for a direction u. A
    capsule's point that is farthest from the hull has the distance  max over u of h_capsule(u) -
    h_hull(u). The mean is the mean over u of  h_capsules(u) - h_hull(u). The greatest excess is
    evaluated in the normals of the hull's faces, too.
    """
    spread = directions()
    every = np.concatenate([spread, ConvexHull(points, qhull_options="QJ").equations[:, :3]])
    reach = np.max(np.max(ends @ every.T, axis=1) + radius[:, None], axis=0)
    excess = reach - np.max(every @ points.T, axis=1)
    return float(np.max(excess)), float(np.mean(excess[: len(spread)]))


@functools.cache
def directions(num: int = 2000) -> np.ndarray:
    """Return unit vectors (num, 3) that are spread evenly, on a spiral of the golden angle."""
    z = 1.0 - (2.0 * np.arange(num) + 1.0) / num
    angle, off = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(num), np.sqrt(1.0 - z * z)
    return np.stack([off * np.cos(angle), off * np.sin(angle), z], axis=1)


def _principal_axes(points: np.ndarray) -> np.ndarray:
    """Return unit vectors (3, 3), one a row, in the order of the points' spread along them."""
    away = points - points.mean(axis=0)
    return np.linalg.eigh(away.T @ away)[1].T[::-1]


def _slabs(edges: np.ndarray, axis: np.ndarray, num: int) -> list[np.ndarray]:
    """Cut a hull with edges (E, 2, 3) into slabs across an axis; return their corners."""
    first, second = np.moveaxis(edges, 1, 0)
    low, high = first @ axis, second @ axis
    planes = np.linspace(np.min(low, initial=np.min(high)), np.max([low, high]), num + 1)
    slabs = []
    for bottom, top in itertools.pairwise(planes):
        corners = [end[(s >= bottom) & (s <= top)] for end, s in ((first, low), (second, high))]
        for plane in (bottom, top):
            across = (low - plane) * (high - plane) < 0.0
            share = ((plane - low[across]) / (high - low)[across])[:, None]
            corners.append(first[across] + share * (second - first)[across])
        slabs.append(np.unique(np.concatenate(corners), axis=0))
    return slabs


def _enclose(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return ends (2, 3) [m] and radius [m] of a capsule of small mean width that holds points.

    The mean width of a capsule with an axis of length l and radius r is  l / 2 + 2 r.
    """
    few = points[np.unique(np.argmax(points @ directions(300).T, axis=0))]
    centre = few.mean(axis=0)
    axes = _principal_axes(few)
    size = np.max(np.linalg.norm(few - centre, axis=1))

    def capsule(x: np.ndarray, frame: np.ndarray, points: np.ndarray) -> tuple:
        axis = frame[0] + x[0] * frame[1] + x[1] * frame[2]
        axis = axis / math.sqrt(axis @ axis)
        origin = centre + size * (x[2] * frame[1] + x[3] * frame[2])
        away = points - origin
        along = away @ axis
        off = np.maximum(np.einsum("ij,ij->i", away, away) - along**2, 0.0)
        square = np.max(off) * (1.0 + x[4] ** 2)
        # The spheres around the ends contain a point if it is at most `depth` beyond the end.
        depth = np.sqrt(square - off)
        start, end = np.min(along + depth), np.max(along - depth)
        if start > end:  # a sphere: every centre between both contains all points
            start = end = 0.5 * (start + end)
        return origin, axis, start, end, math.sqrt(square)

    def width(x: np.ndarray, frame: np.ndarray) -> float:
        *_, start, end, radius = capsule(x, frame, few)
        return 0.5 * (end - start) + 2.0 * radius

    simplex = np.vstack([np.zeros(5), 0.2 * np.eye(5)]) + [0.0, 0.0, 0.0, 0.0, 0.3]
    options = {"maxiter": 250, "xatol": 1e-3, "fatol": 1e-5, "initial_simplex": simplex}
    best = []
    for first in range(2):  # start from capsules along the two longest principal axes
        frame = np.roll(axes, -first, axis=0)
        found = minimize(width, simplex[0], (frame,), method="Nelder-Mead", options=options)
        best.append((found.fun, first, found.x, frame))
    _, _, x, frame = min(best, key=lambda each: each[:2])
    origin, axis, start, end, radius = capsule(x, frame, points)
    return origin + np.outer([start, end], axis), radius + _ROUNDING


def prism_points(sides: int = 64) -> np.ndarray:
    """Return corners of a prism that encloses the cylinder of radius 1 from z = -1 to 1."""
    angle, radius = np.arange(sides) * (2.0 * np.pi / sides), 1.0 / np.cos(np.pi / sides)
    rim = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], axis=1)
    return np.concatenate([rim - [0.0, 0.0, 1.0], rim + [0.0, 0.0, 1.0]])


def ball_points() -> np.ndarray:
    """Return corners of a polyhedron that encloses the ball of radius 1."""
    corners = directions(600)
    return corners / np.min(-ConvexHull(corners).equations[:, 3])
