"""Poses of a car's body along B plans, by float64 quadrature of the car's equations of motion.

Speed and curvature of a plan are linear in time between its K + 1 knots [Qu2022, eq. 1], so the
heading is a cubic polynomial of time on each of the K pieces. Arguments `case` are dicts of float64
arrays (B, ...): "plan.start", "plan.speed", "plan.curvature", "body.length", "body.rear_overhang".
"""

import dataclasses

import numpy as np

LONGEST_STEP = 0.02  # [s], greatest time between two samples of the motion
LONGEST_PLAN = 3600.0  # [s], greatest time of a plan that the referee accepts
# Nodes and weights of the Gauss-Legendre quadrature by which velocities are integrated to
# positions; it is exact for polynomials up to degree 5.
_NODES = np.polynomial.legendre.leggauss(3)
_NODE, _WEIGHT = 0.5 * (_NODES[0] + 1.0), 0.5 * _NODES[1]


@dataclasses.dataclass(frozen=True)
class _Pieces:
    """Speed and curvature at the start of pieces of plans, their slopes in time, and the heading.

    All arrays have the same shape.
    """

    speed: np.ndarray  # [m/s]
    curvature: np.ndarray  # [1/m]
    rise: np.ndarray  # [m/s^2]
    bend: np.ndarray  # [1/(m s)]
    heading: np.ndarray  # [rad]

    def turn(self, tau: np.ndarray) -> np.ndarray:
        """Return the change of heading [rad] in the time `tau` [s] since the start of the piece."""
        v, k, rise, bend = self.speed, self.curvature, self.rise, self.bend
        return tau * (v * k + tau * (0.5 * (v * bend + rise * k) + tau * rise * bend / 3.0))

    def move(self, tau: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return the displacement (..., 2) [m] of the rear axle from `tau` to `tau + step` [s]."""
        x, y = np.zeros((2, *np.broadcast_shapes(self.speed.shape, tau.shape)))
        for node, weight in zip(_NODE, _WEIGHT, strict=True):
            at = tau + node * step
            angle, length = self.heading + self.turn(at), weight * step
            length = length * (self.speed + self.rise * at)
            x += length * np.cos(angle)
            y += length * np.sin(angle)
        return np.stack([x, y], axis=-1)

    def take(self, which: np.ndarray) -> "_Pieces":
        """Return the pieces (B, M) with the indices `which` (B, M) along the second axis."""
        parts = {name: np.take_along_axis(leaf, which, 1) for name, leaf in vars(self).items()}
        return _Pieces(**parts)


def sample_poses(
    case: dict, span: np.ndarray, count: np.ndarray, extra: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return times (B, S) [s] and poses (B, S, 3) of the body's middle; the last is at the end.

    Args:
        case: dict of arrays, as in the module's docstring.
        span: (B,) [s], duration of a piece.
        count: (B,), number of equal steps into which each piece is divided.
        extra: (B, M) [s], other times of samples. Times outside of the plan are moved to its ends.
    """
    v, k = case["plan.speed"], case["plan.curvature"]
    (batch, num), h = (len(v), v.shape[1] - 1), span[:, None]
    rise, bend = (np.where(h > 0.0, np.diff(each) / h, 0.0) for each in (v, k))
    pieces = _Pieces(v[:, :-1], k[:, :-1], rise, bend, np.zeros_like(rise))
    whole = pieces.turn(h)
    before = case["plan.start"][:, 2:] + np.cumsum(whole, axis=1) - whole  # (B, K)
    pieces = dataclasses.replace(pieces, heading=before)
    most = int(count.max(initial=1.0))
    tau = h * np.minimum(np.arange(most + 1) / count[:, None], 1.0)  # (B, most + 1)
    columns = _Pieces(**{name: leaf[..., None] for name, leaf in vars(pieces).items()})
    moved = columns.move(tau[:, None, :-1], np.diff(tau, axis=1)[:, None])
    heading = before[..., None] + columns.turn(tau[:, None, :-1])
    times = (h * np.arange(num))[..., None] + tau[:, None, :-1]
    place = case["plan.start"][:, None, :2] + np.zeros((batch, num * most + 1, 2))
    place[:, 1:] += np.cumsum(moved.reshape(batch, num * most, 2), axis=1)
    # The step in which an extra time lies starts at the sample with the index `index`.
    extra = np.clip(extra, 0.0, num * h)
    which = np.clip(np.nan_to_num(extra / h), 0, num - 1).astype(int)
    since = extra - which * h
    step = np.clip(np.floor(np.nan_to_num(since / h) * count[:, None]), 0, count[:, None] - 1)
    index = which * most + step.astype(int)
    of_extra, at = pieces.take(which), h * (step / count[:, None])
    beside = np.take_along_axis(place, index[..., None], 1) + of_extra.move(at, since - at)
    place = np.concatenate([place[:, :-1], beside, place[:, -1:]], axis=1)
    parts = [heading.reshape(batch, num * most), of_extra.heading + of_extra.turn(since)]
    heading = np.concatenate([*parts, before[:, -1:] + whole[:, -1:]], axis=1)
    times = np.concatenate([times.reshape(batch, num * most), extra, num * h], axis=1)
    ahead = (0.5 * case["body.length"] - case["body.rear_overhang"])[:, None, None]
    middle = place + ahead * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return times, np.concatenate([middle, heading[..., None]], axis=-1)


def final_poses(plans, body) -> np.ndarray:
    """Return the rear axles' poses (x [m], y [m], heading [rad]) at the end of B plans, (B, 3)."""
    case = {f"plan.{name}": getattr(plans, name) for name in ("start", "speed", "curvature")}
    case |= {f"body.{name}": getattr(body, name) for name in ("length", "rear_overhang")}
    case = {name: np.asarray(leaf, np.float64) for name, leaf in case.items()}
    end = np.asarray(plans.time, np.float64)
    # For a plan whose time is not in (0, `LONGEST_PLAN`], the start pose is returned.
    end = np.where((end > 0.0) & (end <= LONGEST_PLAN), end, 0.0)
    span = end / (case["plan.speed"].shape[1] - 1)
    count = np.maximum(np.ceil(span / LONGEST_STEP - 1e-9), 1.0)
    with np.errstate(all="ignore"):
        pose = sample_poses(case, span, count, np.zeros((len(end), 0)))[1][:, -1]
    ahead = 0.5 * case["body.length"] - case["body.rear_overhang"]
    pose[:, 0] -= ahead * np.cos(pose[:, 2])
    pose[:, 1] -= ahead * np.sin(pose[:, 2])
    return pose
