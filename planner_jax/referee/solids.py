"""Distances in space of points, segments, boxes and cylinders, in float64 NumPy, to rounding.

Vectors (3, ...) [m] have their x, y, z components on the first axis; the other axes broadcast.
"""

import itertools

import numpy as np

# Two edges count as parallel if the norm of their unit vectors' cross product is below this number.
_PARALLEL = 1e-9


def dot(a: np.ndarray | list, b: np.ndarray | list) -> np.ndarray:
    """Return the inner products (...) of vectors (3, ...), or of lists of three components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def length(vector: np.ndarray | list) -> np.ndarray:
    """Return the Euclidean norms (...) of vectors (3, ...)."""
    return np.sqrt(dot(vector, vector))


def rotate(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the products R v of rotation matrices R (3, 3, ...) and vectors v (3, ...)."""
    return np.stack([dot(rotation[k], vector) for k in range(3)])


def rotate_back(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the products R' v of transposed matrices R (3, 3, ...) and vectors v (3, ...)."""
    return np.stack([dot(rotation[:, k], vector) for k in range(3)])


def from_segment(point: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the distances [m] of points from the segments `first` to `second`, all (3, ...)."""
    span, away = second - first, point - first
    return length(away - np.clip(_ratio(dot(away, span), dot(span, span)), 0.0, 1.0) * span)


def between_segments(
    first: np.ndarray, second: np.ndarray, third: np.ndarray, fourth: np.ndarray
) -> np.ndarray:
    """Return the distances [m] between segments `first` to `second` and `third` to `fourth`.

    The arrays are (3, ...). The method is Ericson's (Real-Time Collision Detection, Section 5.1.9).
    """
    span, other, away = second - first, fourth - third, first - third
    a, b, c = dot(span, span), dot(span, other), dot(other, other)
    d, e = dot(span, away), dot(other, away)
    share = np.clip(_ratio(b * e - c * d, a * c - b * b), 0.0, 1.0)
    along = np.clip(_ratio(b * share + e, c), 0.0, 1.0)
    share = np.clip(_ratio(b * along - d, a), 0.0, 1.0)
    return length(away + share * span - along * other)


def segment_to_box(first: np.ndarray, second: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return the distances (...) [m] of line segments from axis-aligned boxes around the origin.

    `first` and `second` (3, ...) [m] are the ends of the segments, `half` (3, ...) [m] the half
    edges of the boxes. The squared distance is convex along a segment, and its derivative is linear
    between the planes of the box's sides. The minimum is where the derivative is zero.
    """
    span = second - first

    def beyond(share: np.ndarray) -> list:
        point = [first[k] + share * span[k] for k in range(3)]
        return [x - np.clip(x, -half[k], half[k]) for k, x in enumerate(point)]

    low, high = np.zeros(span.shape[1:]), np.ones(span.shape[1:])
    crossings = [(sign * half[k] - first[k], span[k]) for k in range(3) for sign in (-1.0, 1.0)]
    below, above = np.zeros_like(low), np.zeros_like(low)
    for share in (low, high, *(np.clip(_ratio(*crossing), 0.0, 1.0) for crossing in crossings)):
        slope = dot(beyond(share), span)
        later, earlier = (slope <= 0.0) & (share >= low), (slope >= 0.0) & (share <= high)
        low, below = np.where(later, share, low), np.where(later, slope, below)
        high, above = np.where(earlier, share, high), np.where(earlier, slope, above)
    share = low - _ratio(below * (high - low), above - below)
    return length(beyond(np.clip(share, 0.0, 1.0)))


def from_cylinder(
    point: np.ndarray, first: np.ndarray, second: np.ndarray, radius: np.ndarray
) -> np.ndarray:
    """Return the vectors (3, ...) [m] to points from the nearest points of cylinders.

    The axes of the cylinders lead from `first` to `second`, which differ. A vector is zero for a
    point inside a cylinder.
    """
    away, axis = point - 0.5 * (first + second), second - first
    span = length(axis)
    axis = axis / span
    height = dot(away, axis)
    across = away - height * axis
    off = length(across)
    beyond = height - np.clip(height, -0.5 * span, 0.5 * span)
    return across * np.maximum(1.0 - _ratio(radius, off), 0.0) * (off > 0.0) + beyond * axis


def between_boxes(
    middle: np.ndarray, rotation: np.ndarray, half: np.ndarray, other: np.ndarray
) -> np.ndarray:
    """Return the distances (P,) [m] between P pairs of boxes.

    Where two boxes overlap, the distance is minus the penetration depth, the least overlap along
    any of the 15 axes of the separating axis theorem. Otherwise it is the least distance of an edge
    of one box from the other box.

    Args:
        middle: (3, P) [m], centre of the first box in the frame of the second box.
        rotation: (3, 3, P), from the frame of the first box to the frame of the second box.
        half: (3, P) [m], half edges of the first box.
        other: (3, P) [m], half edges of the second box, which is centred at the origin.
    """
    axes = [np.broadcast_to(axis[:, None], middle.shape) for axis in np.eye(3)]
    own = [rotation[:, k] for k in range(3)]
    gap = np.full(middle.shape[1:], -np.inf)
    for axis in (*axes, *own, *(np.cross(a, b, axis=0) for a in axes for b in own)):
        size = length(axis)
        reach = dot(np.abs(axis), other) + sum(
            half[k] * np.abs(dot(axis, own[k])) for k in range(3)
        )
        apart = _ratio(np.abs(dot(axis, middle)) - reach, size)
        gap = np.where(size > _PARALLEL, np.maximum(gap, apart), gap)
    free = np.flatnonzero(gap > 0.0)
    middle, rotation, half, other = (part[..., free] for part in (middle, rotation, half, other))
    out, back = -rotate_back(rotation, middle), np.swapaxes(rotation, 0, 1)
    gap[free] = np.minimum(
        _edges_to_box(middle, rotation, half, other), _edges_to_box(out, back, other, half)
    )
    return gap


def _edges_to_box(middle, rotation, half, other) -> np.ndarray:
    """Return the least distances (P,) [m] of the first boxes' 12 edges from the second boxes.

    As in `between_boxes`, each second box is centred at the origin of its own frame. In this frame
    the first box has its centre `middle` (3, P) [m]; `rotation` (3, 3, P) maps the first box's
    frame to it. Half edges (3, P) [m] are `half` for first boxes and `other` for second boxes.
    """
    edges = rotation * half  # (3, 3, P), three vectors along the edges, half as long as an edge
    starts = [
        middle + first * edges[:, (k + 1) % 3] + second * edges[:, (k + 2) % 3] - edges[:, k]
        for k, first, second in itertools.product(range(3), (-1.0, 1.0), (-1.0, 1.0))
    ]
    starts, spans = np.stack(starts, axis=1), np.repeat(2.0 * edges, 4, axis=1)  # (3, 12, P)
    return segment_to_box(starts, starts + spans, other[:, None]).min(axis=0)


def _ratio(value: np.ndarray, by: np.ndarray) -> np.ndarray:
    none = by == 0.0
    return np.where(none, 0.0, value / np.where(none, 1.0, by))
