"""Clearance of a moving rectangle, a car's body, from convex polygons, in float64 NumPy."""

import numpy as np

# Number of distances between a pose and a polygon that are computed together and fit the cache.
_PAIRS = 16384
# [m] Greatest rounding error of a bound of a distance; a shorter edge counts as a point.
_SLACK = 1e-9


def clearances(group: dict, half: np.ndarray, times: np.ndarray, poses: np.ndarray) -> tuple:
    """Return the least distance (B,) [m] of each moving rectangle from N moving polygons.

    Also returns the time (B,) [s] of the least distance and the index (B,) of the polygon. Lower
    bounds of the distance exclude most pairs of a sample and a polygon.

    Args:
        group: the polygons, as arrays "centre" [m] and "velocity" [m/s] (B, N, 2), "corners" (B, N,
            V, 2) [m] relative to the centre, and "present" (B, N).
        half: (B, 2) [m], half sides of the rectangles.
        times: (B, S) [s], of the samples.
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
        """Return the exact distances (P,) [m] of P pairs of a sample and a polygon."""
        parts = [np.zeros(0)]
        for part in (slice(k, k + _PAIRS) for k in range(0, len(lane), _PAIRS)):
            b, s, n = lane[part], sample[part], which[part]
            centre = group["centre"][b, n] + group["velocity"][b, n] * times[b, s, None]
            corners, pose = centre[:, None] + group["corners"][b, n], poses[b, s]
            parts.append(_separation(corners, normals[b, n], pose, half[b]))
        return np.concatenate(parts)

    def closest(bound: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Return the index of each plan's least `bound` (P,); `of` (P,) has rising plan indices."""
        lowest = np.full(num_lanes, np.inf)
        np.minimum.at(lowest, of, bound)
        hits = np.flatnonzero(bound == lowest[of])
        return hits[np.unique(of[hits], return_index=True)[1]]

    # Any exact distance is an upper bound of the least distance; a second pair may lower it.
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
    """Return outward unit normals (..., V, 2) and offsets (..., V) [m] of the edges of polygons."""
    edge = np.roll(corners, -1, axis=-2) - corners
    area = (corners[..., 0] * edge[..., 1] - corners[..., 1] * edge[..., 0]).sum(axis=-1)
    length = np.linalg.norm(edge, axis=-1)
    out = np.stack([edge[..., 1], -edge[..., 0]], axis=-1) * np.sign(area)[..., None, None]
    is_edge = length > _SLACK
    normals = np.where(is_edge[..., None], out / np.where(is_edge, length, 1.0)[..., None], 0.0)
    return normals, np.where(is_edge, (normals * corners).sum(axis=-1), np.inf)


def _separation(corners, normals, pose, half) -> np.ndarray:
    """Return distances (P,) [m] of rectangles from polygons; minus the depth where they overlap.

    If the greatest gap along the normals of all edges is negative, it is minus the depth. Otherwise
    the distance is between a corner and an edge. `half` (P, 2) [m] are half sides of the
    rectangles.
    """
    cos, sin = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])

    def rotate(vectors: np.ndarray) -> np.ndarray:
        """Rotate vectors (P, V, 2) into the rectangle's frame."""
        x, y = vectors[..., 0], vectors[..., 1]
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=2)

    points, out = rotate(corners - pose[:, None, :2]), rotate(normals)
    height = (out * points).sum(axis=2)
    beyond = -height - (np.abs(out) * half[:, None]).sum(axis=2)
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
        share = np.clip((away * edge).sum(axis=2) / square, 0.0, 1.0)
        away = away - share[..., None] * edge
        nearest = np.minimum(nearest, (away**2).sum(axis=2).min(axis=1))
    gap[free] = np.sqrt(nearest)
    return gap
