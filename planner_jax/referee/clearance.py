"""How far a rectangle that drives stays from convex polygons, in float64 NumPy.

It shares no code with the planners. World frame in the plane, SI units.
"""

import numpy as np

# Pairs of a pose and a polygon whose distance is worked out at once: few enough for the cache.
_PAIRS = 16384
# What rounding may do to a bound, and shorter than any edge [m].
_SLACK = 1e-9


def clearances(group: dict, half: np.ndarray, times: np.ndarray, poses: np.ndarray) -> tuple:
    """Return least distance (B,) [m] of rectangles from polygons, when (B,) [s], and of which (B,).

    Pairs of a sample and an obstacle that bounds show to be farther apart than another pair of
    their lane are left out: first by circles around both, then by the lines of the polygon's
    edges and a circle around the rectangle.

    Args:
        group: "centre" and "velocity" (B, N, 2), "corners" (B, N, V, 2), "present" (B, N).
        half: (B, 2) [m], half sides of the rectangles.
        times: (B, S) [s].
        poses: (B, S, 3), of the rectangles' middles.
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
    apart = np.sqrt(apart) - reach[:, None]  # infinite for absent ones

    def exact(lane: np.ndarray, sample: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Return distances (P,) of so many pairs."""
        found = [np.zeros(0)]
        for part in (slice(k, k + _PAIRS) for k in range(0, len(lane), _PAIRS)):
            b, s, n = lane[part], sample[part], which[part]
            centre = group["centre"][b, n] + group["velocity"][b, n] * times[b, s, None]
            corners, pose = centre[:, None] + group["corners"][b, n], poses[b, s]
            found.append(_separation(corners, normals[b, n], pose, half[b]))
        return np.concatenate(found)

    def closest(bound: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Return the index of the least `bound` (P,) of each lane in `of`, whose lanes rise."""
        lowest = np.full(num_lanes, np.inf)
        np.minimum.at(lowest, of, bound)
        hits = np.flatnonzero(bound == lowest[of])
        return hits[np.unique(of[hits], return_index=True)[1]]

    # One pair of each lane bounds its least distance from above; then a better one.
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
    """Return outward unit normals (..., V, 2) of polygons (..., V, 2), and the edges' heights.

    The height (..., V) [m] of an edge is how far out along its normal it lies. One without
    length, between repeated corners, has no normal, and lies infinitely far out.
    """
    edge = np.roll(corners, -1, axis=-2) - corners
    area = (corners[..., 0] * edge[..., 1] - corners[..., 1] * edge[..., 0]).sum(axis=-1)
    length = np.linalg.norm(edge, axis=-1)
    out = np.stack([edge[..., 1], -edge[..., 0]], axis=-1) * np.sign(area)[..., None, None]
    is_edge = length > _SLACK
    normals = np.where(is_edge[..., None], out / np.where(is_edge, length, 1.0)[..., None], 0.0)
    return normals, np.where(is_edge, (normals * corners).sum(axis=-1), np.inf)


def _separation(corners, normals, pose, half) -> np.ndarray:
    """Return distances (P,) [m] of rectangles from polygons; minus the depth where they overlap.

    The greatest gap along the normal of an edge is negative where the two overlap, and is the
    shortest way out. Elsewhere the distance is from a corner of one of them to the other. An edge
    without length has a zero normal; `half` (P, 2) [m] are half sides.
    """
    cos, sin = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])

    def turned(vectors: np.ndarray) -> np.ndarray:
        """Return vectors (P, V, 2) in the rectangle's frame."""
        x, y = vectors[..., 0], vectors[..., 1]
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=2)

    place, out = turned(corners - pose[:, None, :2]), turned(normals)
    height = (out * place).sum(axis=2)
    beyond = -height - (np.abs(out) * half[:, None]).sum(axis=2)
    beyond = np.where(out.any(axis=2), beyond, -np.inf).max(axis=1)
    beside = np.maximum(place.min(axis=1), -place.max(axis=1)) - half
    gap = np.maximum(beyond, beside.max(axis=1))
    free = np.flatnonzero(gap > 0.0)
    place, half = place[free], half[free]
    nearest = (np.maximum(np.abs(place) - half[:, None], 0.0) ** 2).sum(axis=2).min(axis=1)
    edge = np.roll(place, -1, axis=1) - place
    square = np.maximum((edge**2).sum(axis=2), _SLACK**2)
    for signs in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
        away = (half * signs)[:, None] - place
        share = np.clip((away * edge).sum(axis=2) / square, 0.0, 1.0)
        away = away - share[..., None] * edge
        nearest = np.minimum(nearest, (away**2).sum(axis=2).min(axis=1))
    gap[free] = np.sqrt(nearest)
    return gap
