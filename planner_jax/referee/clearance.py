"""Clearance of a moving rectangle, a car's body, from convex polygons, in float64 NumPy."""

import numpy as np

# Greatest number of distances, each between a car's pose and a polygon, that are computed together.
# The memory of so many fits the processor's cache.
_PAIRS = 16384
# [m] Greatest rounding error of a bound of a distance. A polygon's edge that is shorter than this
# length counts as a point.
_SLACK = 1e-9


def clearances(group: dict, half: np.ndarray, times: np.ndarray, poses: np.ndarray) -> tuple:
    """Return the least distance (B,) [m] of each of B moving rectangles from N moving polygons.

    Also returns the time (B,) [s] of the least distance and the index (B,) of the polygon. Exact
    distances are computed only for polygons and times whose lower bound is small enough.

    Args:
        group: the polygons, as arrays "centre" [m] and "velocity" [m/s] (B, N, 2), "corners" (B, N,
            V, 2) [m] of V corners relative to the centre, and "present" (B, N).
        half: (B, 2) [m], half sides of the rectangles.
        times: (B, S) [s], S times at which the distance is sampled.
        poses: (B, S, 3), pose of the rectangle's middle: x [m], y [m], heading [rad].
    """
    num_lanes, num_samples, num = *times.shape, group["present"].shape[1]
    least, when = np.full(num_lanes, np.inf), np.zeros(num_lanes)
    nearest = np.full(num_lanes, -1)
    if num == 0:
        return least, when, nearest
    normals, offsets = _edges(group["corners"])
    around, radius = np.linalg.norm(half, axis=1), np.linalg.norm(group["corners"], axis=3).max(2)
    reach = np.where(group["present"] != 0.0, around[:, None] + radius, -np.inf)  # (B, N)
    apart = np.zeros((num_lanes, num_samples, num))
    for axis in range(2):
        centre, velocity = (group[key][:, None, :, axis] for key in ("centre", "velocity"))
        apart += (poses[..., axis, None] - centre - velocity * times[..., None]) ** 2
    apart = np.sqrt(apart) - reach[:, None]  # infinite for absent polygons

    def exact(lane: np.ndarray, sample: np.ndarray, which: np.ndarray) -> np.ndarray:
        parts = [np.zeros(0)]
        for part in (slice(k, k + _PAIRS) for k in range(0, len(lane), _PAIRS)):
            b, s, n = lane[part], sample[part], which[part]
            centre = group["centre"][b, n] + group["velocity"][b, n] * times[b, s, None]
            corners, pose = centre[:, None] + group["corners"][b, n], poses[b, s]
            parts.append(_separation(corners, normals[b, n], pose, half[b]))
        return np.concatenate(parts)

    def closest(bound: np.ndarray, of: np.ndarray) -> np.ndarray:
        lowest = np.full(num_lanes, np.inf)
        np.minimum.at(lowest, of, bound)
        hits = np.flatnonzero(bound == lowest[of])
        return hits[np.unique(of[hits], return_index=True)[1]]

    # Each exact distance is an upper bound of the least distance. Pairs of a time and a polygon
    # with a greater lower bound are excluded: by enclosing circles, then by the polygon's edges.
    lanes = np.arange(num_lanes)
    sample, which = np.divmod(apart.reshape(num_lanes, num_samples * num).argmin(axis=1), num)
    upper = exact(lanes, sample, which) + _SLACK
    upper[~group["present"].any(axis=1)] = -np.inf
    lane, sample, which = np.nonzero(apart <= upper[:, None, None])
    moved = poses[lane, sample, :2] - group["centre"][lane, which]
    moved -= group["velocity"][lane, which] * times[lane, sample, None]
    bound = np.full(len(lane), -np.inf)
    for edge in range(normals.shape[2]):
        height = (normals[lane, which, edge] * moved).sum(axis=1) - offsets[lane, which, edge]
        np.maximum(bound, height - around[lane], out=bound)
    pick = closest(bound, lane)
    upper[lane[pick]] = exact(lane[pick], sample[pick], which[pick]) + _SLACK
    kept = np.flatnonzero(bound <= upper[lane])
    lane, sample, which = lane[kept], sample[kept], which[kept]
    distance = exact(lane, sample, which)
    pick = closest(distance, lane)
    found = lane[pick]
    least[found], when[found] = distance[pick], times[found, sample[pick]]
    nearest[found] = which[pick]
    return least, when, nearest


def _edges(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the outward unit normals n and the offsets d [m] of polygons' edges: n . x = d."""
    edge = np.roll(corners, -1, axis=-2) - corners
    area = (corners[..., 0] * edge[..., 1] - corners[..., 1] * edge[..., 0]).sum(axis=-1)
    length = np.linalg.norm(edge, axis=-1)
    out = np.stack([edge[..., 1], -edge[..., 0]], axis=-1) * np.sign(area)[..., None, None]
    is_edge = length > _SLACK
    normals = np.where(is_edge[..., None], out / np.where(is_edge, length, 1.0)[..., None], 0.0)
    return normals, np.where(is_edge, (normals * corners).sum(axis=-1), np.inf)


def _separation(corners, normals, pose, half) -> np.ndarray:
    """Return distances [m] of rectangles from polygons, or minus the depth of their overlap.

    The gap along the normal of each edge is computed. If the greatest gap is negative, it is minus
    the depth of the overlap. Otherwise the distance is between a corner of one shape and an edge of
    the other. `half` has the half sides [m] of each rectangle.
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
    square = np.maximum((edge**2).sum(axis=2), _SLACK**2)
    for signs in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
        away = (half * signs)[:, None] - points
        away = away - np.clip((away * edge).sum(axis=2) / square, 0.0, 1.0)[..., None] * edge
        nearest = np.minimum(nearest, (away**2).sum(axis=2).min(axis=1))
    gap[free] = np.sqrt(nearest)
    return gap
