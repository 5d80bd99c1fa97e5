"""Clearance of a moving rectangle, a car's body, from enlarged convex polygons, in float64 NumPy.

A polygon is enlarged on all sides by a radius, so a polygon of one repeated corner is a disc, and a
polygon of two corners is a capsule.
"""

import dataclasses

import numpy as np

# Greatest number of distances, each between a car's pose and a polygon, that are computed together.
# The memory of so many fits the processor's cache.
_PAIRS = 16384
# Greatest rounding error of a bound of a distance, relative to the greatest length in its numbers.
_SLACK = 1e-12
# An edge that is shorter than this share of its polygon's longest edge counts as a point.
_SHORTEST_EDGE = 1e-9


@dataclasses.dataclass(frozen=True)
class _Placement:
    """Frames and radii of N polygons at S times, in B lanes; arrays are (B, S, N)."""

    x: np.ndarray  # [m], origin of the frame
    y: np.ndarray  # [m]
    heading: np.ndarray | None  # [rad], direction of the frame; None: the polygons do not turn
    radius: np.ndarray  # [m], distance by which the polygon is enlarged
    exists: np.ndarray  # bool


def clearances(group: dict, half: np.ndarray, times: np.ndarray, poses: np.ndarray) -> tuple:
    """Return the least distance (B,) [m] of each of B moving rectangles from N moving polygons.

    Also returns the time (B,) [s] of the least distance and the index (B,) of the polygon. Exact
    distances are computed only for polygons and times whose lower bound is small enough.

    Args:
        group: the polygons, as arrays "centre" [m] and "velocity" [m/s] (B, N, 2), "corners" (B, N,
            V, 2) [m] of V corners relative to the centre, and "present" (B, N). If it has "radius"
            [m] and "growth" [m/s] (B, N), polygons are enlarged by radius + growth * time. If it
            has "track.poses" (B, N, K, 3), and "track.begin", "track.step" and "track.end" (B, N)
            [s], these K poses, x [m], y [m] and heading [rad], replace centre and velocity. They
            are `step` apart from the time `begin`, linear between two poses, and the polygon exists
            only from `begin` to `end`.
        half: (B, 2) [m], half sides of the rectangles.
        times: (B, S) [s], S times at which the distance is sampled.
        poses: (B, S, 3), pose of the rectangle's middle: x [m], y [m], heading [rad].
    """
    num_lanes, num_samples, num = *times.shape, group["present"].shape[1]
    least, when = np.full(num_lanes, np.inf), np.zeros(num_lanes)
    nearest = np.full(num_lanes, -1)
    if num == 0:
        return least, when, nearest
    placed = _place(group, times)
    normals, offsets = edges(group["corners"])
    around, size = np.linalg.norm(half, axis=1), np.linalg.norm(group["corners"], axis=3).max(2)
    apart = (poses[..., 0, None] - placed.x) ** 2
    apart += (poses[..., 1, None] - placed.y) ** 2
    np.sqrt(apart, out=apart)
    apart -= placed.radius + (around[:, None] + size)[:, None]
    apart[~placed.exists] = np.inf
    apart = apart.reshape(num_lanes, num_samples * num)

    def enter(lane: np.ndarray, sample: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Return poses (P, 3) of rectangles in the frames of polygons."""
        pose = poses[lane, sample]
        x = pose[:, 0] - placed.x[lane, sample, which]
        y = pose[:, 1] - placed.y[lane, sample, which]
        if placed.heading is None:
            return np.stack([x, y, pose[:, 2]], axis=1)
        heading = placed.heading[lane, sample, which]
        cos, sin = np.cos(heading), np.sin(heading)
        return np.stack([cos * x + sin * y, cos * y - sin * x, pose[:, 2] - heading], axis=1)

    def exact(lane: np.ndarray, sample: np.ndarray, which: np.ndarray) -> np.ndarray:
        parts = [np.zeros(0)]
        for part in (slice(k, k + _PAIRS) for k in range(0, len(lane), _PAIRS)):
            b, s, n = lane[part], sample[part], which[part]
            corners = group["corners"][b, n]
            gap = separation(corners, normals[b, n], enter(b, s, n), half[b])
            parts.append(gap - placed.radius[b, s, n])
        return np.concatenate(parts)

    def closest(bound: np.ndarray, of: np.ndarray) -> np.ndarray:
        lowest = np.full(num_lanes, np.inf)
        np.minimum.at(lowest, of, bound)
        hits = np.flatnonzero(bound == lowest[of])
        return hits[np.unique(of[hits], return_index=True)[1]]

    # Each exact distance is an upper bound of the least distance. Pairs of a time and a polygon
    # with a greater lower bound are excluded: by enclosing circles, then by the polygon's edges.
    lanes, first = np.arange(num_lanes), apart.argmin(axis=1)
    sample, which = np.divmod(first, num)
    lengths = [np.abs(poses[..., :2]).max(axis=(1, 2)), size.max(axis=1), around]
    slack = _SLACK * np.max([*lengths, np.abs(apart[lanes, first])], axis=0)
    upper = exact(lanes, sample, which) + slack
    upper[np.isposinf(apart[lanes, first])] = -np.inf
    lane, sample, which = np.nonzero((apart <= upper[:, None]).reshape(num_lanes, num_samples, num))
    moved = enter(lane, sample, which)
    bound = np.full(len(lane), -np.inf)
    for edge in range(normals.shape[2]):
        height = (normals[lane, which, edge] * moved[:, :2]).sum(axis=1)
        np.maximum(bound, height - offsets[lane, which, edge] - around[lane], out=bound)
    bound -= placed.radius[lane, sample, which]
    pick = closest(bound, lane)
    found = lane[pick]
    upper[found] = exact(found, sample[pick], which[pick]) + slack[found]
    kept = np.flatnonzero(bound <= upper[lane])
    lane, sample, which = lane[kept], sample[kept], which[kept]
    distance = exact(lane, sample, which)
    pick = closest(distance, lane)
    found = lane[pick]
    least[found], when[found] = distance[pick], times[found, sample[pick]]
    nearest[found] = which[pick]
    return least, when, nearest


def _place(group: dict, times: np.ndarray) -> _Placement:
    """Return where N polygons are at S times (B, S) [s]."""
    time, zero = times[..., None], np.zeros(group["present"].shape)
    exists = (group["present"] != 0.0)[:, None] & np.ones(time.shape, bool)
    radius, growth = (group.get(name, zero)[:, None] for name in ("radius", "growth"))
    radius = radius + growth * np.maximum(time, 0.0)
    if "track.poses" not in group:
        centre, velocity = group["centre"][:, None], group["velocity"][:, None]
        x, y = (centre[..., k] + velocity[..., k] * time for k in range(2))
        return _Placement(x, y, None, radius, exists)
    begin, step, end = (group[f"track.{name}"][:, None] for name in ("begin", "step", "end"))
    poses = group["track.poses"]
    last = poses.shape[2] - 1
    # Numbers that are not finite belong to lanes that fail for this reason.
    position = np.nan_to_num(np.clip((time - begin) / step, 0.0, last))
    below = np.minimum(np.floor(position), max(last - 1, 0)).astype(int)
    lanes, which = np.arange(len(poses))[:, None, None], np.arange(poses.shape[1])
    before = poses[lanes, which, below]
    after = poses[lanes, which, np.minimum(below + 1, last)]
    pose = before + (position - below)[..., None] * (after - before)
    exists &= (time >= begin) & (time <= end)
    return _Placement(pose[..., 0], pose[..., 1], pose[..., 2], radius, exists)


def greatest_speeds(group: dict) -> np.ndarray:
    """Return bounds (B,) [m/s] of the speeds of all points on the borders of N polygons.

    `group` is the argument of `clearances`, with the arrays "radius" and "growth".
    """
    if "track.poses" in group:
        change = np.diff(group["track.poses"], axis=2) / group["track.step"][..., None, None]
        size = np.linalg.norm(group["corners"], axis=3).max(axis=2)
        speed = np.linalg.norm(change[..., :2], axis=3) + np.abs(change[..., 2]) * size[..., None]
        speed = speed.max(axis=2, initial=0.0)
    else:
        speed = np.linalg.norm(group["velocity"], axis=2)
    speed = np.where(group["present"] != 0.0, speed + group["growth"], 0.0)
    return speed.max(axis=1, initial=0.0)


def edges(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the outward unit normals n and the offsets d [m] of polygons' edges: n . x = d.

    The corners are (..., V, 2) [m] in either orientation. An edge between equal corners has the
    normal 0 and an infinite offset. A polygon of two corners has an edge in both directions.
    """
    edge = np.roll(corners, -1, axis=-2) - corners
    area = (corners[..., 0] * edge[..., 1] - corners[..., 1] * edge[..., 0]).sum(axis=-1)
    length = np.linalg.norm(edge, axis=-1)
    sense = np.where(area < 0.0, -1.0, 1.0)
    out = np.stack([edge[..., 1], -edge[..., 0]], axis=-1) * sense[..., None, None]
    is_edge = length > _SHORTEST_EDGE * length.max(axis=-1, keepdims=True)
    normals = np.where(is_edge[..., None], out / np.where(is_edge, length, 1.0)[..., None], 0.0)
    return normals, np.where(is_edge, (normals * corners).sum(axis=-1), np.inf)


def separation(
    corners: np.ndarray, normals: np.ndarray, pose: np.ndarray, half: np.ndarray
) -> np.ndarray:
    """Return distances (P,) [m] of rectangles from polygons, or minus the depth of their overlap.

    The gap along the normal of each edge is computed. If the greatest gap is negative, it is minus
    the depth of the overlap. Otherwise the distance is between a corner of one shape and an edge of
    the other.

    Args:
        corners: (P, V, 2) [m], of P polygons.
        normals: (P, V, 2), outward unit normals of their edges, from `edges`.
        pose: (P, 3), middle x [m], y [m] and heading [rad] of P rectangles.
        half: (P, 2) [m], half sides of the rectangles; 0 for points.
    """
    cos, sin = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])

    def rotate(vectors: np.ndarray) -> np.ndarray:
        x, y = vectors[..., 0], vectors[..., 1]
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=2)

    points, out = rotate(corners - pose[:, None, :2]), rotate(normals)
    beyond = -(out * points).sum(axis=2) - (np.abs(out) * half[:, None]).sum(axis=2)
    beyond = np.where(out.any(axis=2), beyond, -np.inf).max(axis=1)
    beside = np.maximum(points.min(axis=1), -points.max(axis=1)) - half
    gap = np.maximum(beyond, beside.max(axis=1))
    free = np.flatnonzero(gap > 0.0)
    points, half = points[free], half[free]
    nearest = (np.maximum(np.abs(points) - half[:, None], 0.0) ** 2).sum(axis=2).min(axis=1)
    edge = np.roll(points, -1, axis=1) - points
    square = (edge**2).sum(axis=2)
    square = np.where(square > 0.0, square, 1.0)
    for signs in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
        away = (half * signs)[:, None] - points
        away = away - np.clip((away * edge).sum(axis=2) / square, 0.0, 1.0)[..., None] * edge
        nearest = np.minimum(nearest, (away**2).sum(axis=2).min(axis=1))
    gap[free] = np.sqrt(nearest)
    return gap
