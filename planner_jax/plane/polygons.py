"""Simple polygons, with or without holes, and how to cut them into few convex parts."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from planner_jax.core.checks import numeric
from planner_jax.core.errors import ArgumentError, ArgumentTypeError

# Relative to the polygon's size: lengths below make no difference.
_TOLERANCE = 1e-9
_SIMPLE = "simple: its edges must not cross, and its holes must be inside"

_Chains: TypeAlias = list[list[np.ndarray]]  # lower and upper corners of a part, from left to right


@runtime_checkable
class Geometry(Protocol):
    """A geometry of Shapely or of another package that offers its GeoJSON mapping."""

    @property
    def __geo_interface__(self) -> Mapping[str, object]:
        """The mapping: `type`, `coordinates`, and further entries."""
        ...


Polygon: TypeAlias = ArrayLike | Geometry


def convex_parts(name: str, polygon: object, index: int | None = None) -> list[np.ndarray]:
    """Cut a polygon into few convex parts with the corners (V, 2) [m], counter-clockwise.

    Cuts are parallel or normal to the longest edge, whichever makes fewer parts. A polygon with R
    corners that are not convex has about R + 1 parts. The tolerance is 1e-9 of the polygon's size.

    Args:
        name: name of the argument, for errors.
        polygon: corners (V, 2) [m] in either orientation; or a `Geometry` of the type Polygon or
            MultiPolygon, with or without holes.
        index: index of the polygon in the argument, for errors.

    Raises:
        ArgumentTypeError: the polygon is no array of numbers and no such geometry.
        ArgumentError: a corner is not finite, the polygon has no area, or its edges cross.
    """
    if isinstance(polygon, Geometry):
        return [
            part
            for rings in _rings_of(name, polygon.__geo_interface__, index)
            for part in _cut(name, [_require_ring(name, ring, index) for ring in rings], index)
        ]
    return _cut(name, [_require_ring(name, polygon, index)], index)


def _rings_of(
    name: str, mapping: Mapping[str, object], index: int | None
) -> Sequence[Sequence[object]]:
    kind, found = mapping.get("type"), mapping.get("coordinates")
    if kind == "Polygon" and isinstance(found, Sequence) and found:
        return [found]
    if kind == "MultiPolygon" and isinstance(found, Sequence) and found:
        return found
    rule = "a Polygon or a MultiPolygon with an area"
    raise ArgumentTypeError(name, rule, index=index, shown=f"{kind}")


def _require_ring(name: str, corners: object, index: int | None) -> np.ndarray:
    if numeric(corners) is None:
        raise ArgumentTypeError(name, "corners of numbers", corners, index, verb="have")
    ring = np.asarray(corners, float)
    if ring.ndim != 2 or ring.shape[1:] != (2,) or len(ring) < 3:
        raise ArgumentError(name, "corners (V, 2), V >= 3", ring.shape, index, verb="have")
    if not np.isfinite(ring).all():
        raise ArgumentError(name, "finite", ring, index)
    return ring[:-1] if len(ring) > 3 and (ring[0] == ring[-1]).all() else ring


def _cut(name: str, rings: list[np.ndarray], index: int | None) -> list[np.ndarray]:
    # Corners are computed relative to the first corner and to the size, so that neither the
    # position of the map nor the unit of length makes a difference.
    origin, size = rings[0][0], float(np.ptp(rings[0], axis=0).max())
    if size == 0.0:
        raise ArgumentError(name, "an area", 0, index, verb="have")
    # The coordinates' own rounding errors exceed the tolerance where polygons are far away.
    noise = 4.0 * np.finfo(float).eps * max(float(np.abs(ring).max()) for ring in rings)
    tolerance = max(_TOLERANCE, noise / size)
    scaled = [(ring - origin) / size for ring in rings]
    areas = [_area(ring) for ring in scaled]
    edges = np.roll(scaled[0], -1, axis=0) - scaled[0]
    along = edges[np.argmax(np.linalg.norm(edges, axis=1))]
    along = along / np.linalg.norm(along)
    across = np.array([-along[1], along[0]])
    found: list[list[np.ndarray]] = []
    for axes in (np.array([along, across]), np.array([across, -along])):
        parts = _sweep([ring @ axes.T for ring in scaled], tolerance)
        if isinstance(parts, np.ndarray):
            near = ", ".join(f"{x:g}" for x in origin + size * np.round(parts @ axes, 9))
            raise ArgumentError(name, _SIMPLE, index=index, shown=f"a crossing near ({near})")
        whole, expected = sum(map(_area, parts)), abs(areas[0]) - sum(map(abs, areas[1:]))
        if abs(whole - expected) > 8.0 * tolerance * sum(map(len, rings)):
            raise ArgumentError(name, _SIMPLE, index=index, shown="parts that overlap")
        if whole <= tolerance:
            raise ArgumentError(name, "an area", 0, index, verb="have")
        found.append([origin + size * (part @ axes) for part in parts])
    best = min(found, key=len)
    if len(best) == 1:  # the polygon is convex
        return [rings[0] if areas[0] > 0.0 else rings[0][::-1]]
    return best


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _area(ring: np.ndarray) -> float:
    return 0.5 * float(np.sum(_cross(ring, np.roll(ring, -1, axis=0))))


def _sweep(rings: list[np.ndarray], tolerance: float) -> list[np.ndarray] | np.ndarray:
    """Cut rings into convex parts by lines parallel to y, or return a point where edges cross.

    Between the x of two corners that follow each other, the interior consists of trapezoids. A
    trapezoid is joined to its left neighbour if they share a whole side and the result is convex.
    """
    corners = np.concatenate(rings)
    columns = np.sort(corners[:, 0])
    columns = columns[np.diff(columns, prepend=-np.inf) > tolerance]
    corners[:, 0] = columns[np.searchsorted(columns, corners[:, 0] + tolerance) - 1]
    bounds = np.cumsum([0, *map(len, rings)])
    pairs = [(corners[a:b], np.roll(corners[a:b], -1, axis=0)) for a, b in pairwise(bounds)]
    one, two = (np.concatenate(each) for each in zip(*pairs, strict=True))
    is_first_left = (one[:, 0] <= two[:, 0])[:, None]
    left, right = np.where(is_first_left, one, two), np.where(is_first_left, two, one)
    parts: list[_Chains] = []
    fresh: list[_Chains] = []  # the parts that end at the present column
    for low, high in pairwise(columns):
        edges = np.flatnonzero((left[:, 0] <= low) & (right[:, 0] >= high))
        slope = (right - left)[edges, 1] / (right - left)[edges, 0]
        a, b = (left[edges, 1] + (x - left[edges, 0]) * slope for x in (low, high))
        order = np.argsort(a + b, kind="stable")
        # Edges along a column must not cross edges that continue to its other side.
        ends = np.stack([left, right])[:, (left[:, 0] == low) & (right[:, 0] == low), 1]
        below, above = np.sort(ends, axis=0)[:, :, None] + [[[tolerance]], [[-tolerance]]]
        passing = a[left[edges, 0] < low]
        if (cut := (below < passing) & (passing < above)).any():
            return np.array([low, passing[cut.any(axis=0)][0]])
        a, b = a[order], b[order]
        gap, next_gap = np.diff(a), np.diff(b)
        if (swapped := np.minimum(gap, next_gap) < -tolerance).any():
            k = int(np.argmax(swapped))
            share = np.clip(gap[k] / (gap[k] - next_gap[k]), 0.0, 1.0)
            return np.array([low + share * (high - low), a[k] + share * (b[k] - a[k])])
        before, fresh = fresh, []
        for k in range(0, len(a), 2):
            if max(a[k + 1] - a[k], b[k + 1] - b[k]) <= tolerance:
                continue  # two edges on one line
            part = [[np.array([low, a[m]]), np.array([high, b[m]])] for m in (k, k + 1)]
            fresh.append(next((old for old in before if _join(old, part, tolerance)), part))
            parts += [part] if fresh[-1] is part else []
    outlines = [np.array([*lower, *upper[::-1]]) for lower, upper in parts]
    steps = [np.abs(ring - np.roll(ring, 1, axis=0)).max(axis=1) for ring in outlines]
    return [ring[step > tolerance] for ring, step in zip(outlines, steps, strict=True)]


def _join(part: _Chains, after: _Chains, tolerance: float) -> bool:
    """Append a trapezoid to a part's lower and upper chain if both share a side and stay convex."""
    if max(abs(p[-1] - q[0]).max() for p, q in zip(part, after, strict=True)) > tolerance:
        return False
    if part[1][-1][1] - part[0][-1][1] <= tolerance:
        return False
    ends = [np.stack([p[-2], p[-1], q[1]]) for p, q in zip(part, after, strict=True)]
    a, b, c = np.stack(ends, axis=1)
    heights = np.array([1.0, -1.0]) * _cross(b - a, c - b) / np.linalg.norm(c - a, axis=1)
    if (heights < -tolerance).any():
        return False
    for chain, other, height in zip(part, after, heights, strict=True):
        if height <= tolerance:
            chain.pop()  # the corner is on a straight line
        chain.append(other[1])
    return True
