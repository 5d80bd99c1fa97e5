"""What may be wrong with an interception that was drawn, so that it is drawn anew.

| what is wrong | |
|---|---|
| target off the map | at any time up to the meeting |
| start near a wall | the body's middle is less than 0.35 m from one |
| meeting near a wall | the target is then less than 0.4 m from one |
| target through a wall | it comes within 0.05 m of one before the meeting |
| mover at the start | the body's middle is less than 0.35 m from one |
| mover at the meeting | the target is then less than 0.4 m from one |
| too far | farther than the car comes straight on at its greatest speed |
| no way | walls part start and meeting point for a disc as wide as the car, on a grid of 0.1 m |
| out of reach | no layer of the reach set meets the target, where that sets the time to meet it |

They are looked at in this order. "too far" and "no way" are safeguards: with the ranges of the
suites they hardly ever apply.

Draws are dictionaries of arrays with leading axis B: "start" and "meeting" (B, 2) [m], the rear
axle's middle and where the target is to be met; the "time" (B,) [s] at which that is, and whether
it is "reached" (B,) by then; the target's "pos" (B, 2) [m], "angle" [rad] and "speed" [m/s] at time
0, and its turn "rate" [rad/s]; corners of "walls" and, at time 0, "movers" (B, N, V, 2) [m],
counter-clockwise and possibly repeated; "walls present" and "movers present" (B, N); and the
"velocity" (B, N, 2) [m/s] of movers. World frame in the plane, SI units.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import ndimage

from planner_jax.task.intercept.spec import Suite

SIZE = 8.0  # [m], side of the map
TOP_SPEED = 1.5  # [m/s]
BODY_MIDDLE = 0.15  # [m], ahead of the rear axle
START_ROOM = 0.35  # [m], from the body's middle at the start to walls and movers
MEETING_ROOM = 0.4  # [m], from the meeting point to walls and movers
TARGET_ROOM = 0.05  # [m], from the target to walls
BODY_ROOM = 0.13  # [m], from the middle of a body that drives to walls: half its width

# Seconds between the places of a target that are looked at, and side [m] of a cell of the grid.
_LOOK, _CELL = 0.1, 0.1


def moved(angle, speed, rate, time) -> np.ndarray:
    """How far (..., 2) [m] a target goes in a time, whose direction at time 0 is `angle`."""
    half = 0.5 * rate * time
    way, chord = angle + half, speed * time * np.sinc(half / np.pi)
    return np.stack([chord * np.cos(way), chord * np.sin(way)], axis=-1)


def _path(suite: Suite, drawn: dict) -> np.ndarray:
    """Where the targets are (B, M, 2) [m] from time 0 to the meeting."""
    times = np.linspace(0.0, drawn["time"], round(suite.time / _LOOK) + 1, axis=1)
    angle, speed, rate = (drawn[name][:, None] for name in ("angle", "speed", "rate"))
    return drawn["pos"][:, None] + moved(angle, speed, rate, times)


def _off_map(suite: Suite, drawn: dict) -> np.ndarray:
    """Whether (B,) the targets leave the map."""
    from_middle = np.abs(_path(suite, drawn) - 0.5 * SIZE)
    return from_middle.max(axis=(1, 2)) > 0.5 * SIZE


def _middle(drawn: dict) -> np.ndarray:
    """The middle (B, 2) [m] of the car's body at the start."""
    return drawn["start"] + [BODY_MIDDLE, 0.0]


def _too_far(_: Suite, drawn: dict) -> np.ndarray:
    """Whether (B,) greatest speed does not suffice."""
    way = drawn["meeting"] - _middle(drawn)
    return np.linalg.norm(way, axis=1) > TOP_SPEED * drawn["time"]


def _room(drawn: dict, kind: str, points: np.ndarray, times: Any = 0.0) -> np.ndarray:
    """Least distance (B,) [m] of points (B, 2) or (B, M, 2) from walls or movers at times (B,)."""
    corners, points = drawn[kind], points if points.ndim == 3 else points[:, None]
    if kind == "movers":
        times = np.broadcast_to(times, len(points))[:, None, None, None]
        corners = corners + times * drawn["velocity"][:, :, None]
    least = np.full(len(points), np.inf)
    for k in range(corners.shape[1]):
        there = drawn[f"{kind} present"][:, k]
        far = _distance(points[there], corners[there, None, k])
        least[there] = np.minimum(least[there], far.min(axis=1))
    return least


def _distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distance (...) [m] of points (..., 2) from convex polygons (..., V, 2); 0 inside.

    The corners are counter-clockwise and may be repeated.
    """
    edge = np.roll(corners, -1, axis=-2) - corners
    away = points[..., None, :] - corners
    square = np.maximum((edge**2).sum(axis=-1), 1e-12)
    share = np.clip((away * edge).sum(axis=-1) / square, 0.0, 1.0)
    left_of = edge[..., 0] * away[..., 1] - edge[..., 1] * away[..., 0] >= 0.0
    gap = ((away - share[..., None] * edge) ** 2).sum(axis=-1).min(axis=-1)
    return np.where(left_of.all(axis=-1), 0.0, np.sqrt(gap))


def _no_way(suite: Suite, drawn: dict) -> np.ndarray:
    """Whether (B,) walls part the start from the meeting point."""
    count = round(SIZE / _CELL)
    middles = (np.arange(count) + 0.5) * _CELL
    parted = np.zeros(len(drawn["start"]), bool)
    for k, ends in enumerate(np.stack([_middle(drawn), drawn["meeting"]], axis=1)):
        free = np.ones((count, count), bool)
        for corners in drawn["walls"][k][drawn["walls present"][k]]:
            lowest = (corners.min(axis=0) - BODY_ROOM) / _CELL - 0.5
            highest = (corners.max(axis=0) + BODY_ROOM) / _CELL - 0.5
            first = np.clip(np.ceil(lowest), 0, count).astype(int)
            last = np.clip(np.floor(highest), -1, count - 1).astype(int) + 1
            box = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
            points = np.stack(np.meshgrid(middles[box[0]], middles[box[1]], indexing="ij"), axis=2)
            free[box] &= _distance(points, corners) > BODY_ROOM
        parts = np.zeros(free.shape, np.int32)
        ndimage.label(free, np.ones((3, 3)), output=parts)
        here, there = parts[tuple((ends / _CELL).astype(int).T)]
        parted[k] = here != there
    return parted


# What is wrong -> whether (B,) it is, in the order in which it is looked at.
_APPLIES: dict[str, Callable[[Suite, dict], np.ndarray]] = {
    "target off the map": _off_map,
    "start near a wall": lambda _, drawn: _room(drawn, "walls", _middle(drawn)) < START_ROOM,
    "meeting near a wall": lambda _, drawn: _room(drawn, "walls", drawn["meeting"]) < MEETING_ROOM,
    "target through a wall": lambda suite, drawn: (
        _room(drawn, "walls", _path(suite, drawn)) < TARGET_ROOM
    ),
    "mover at the start": lambda _, drawn: _room(drawn, "movers", _middle(drawn)) < START_ROOM,
    "mover at the meeting": lambda _, drawn: (
        _room(drawn, "movers", drawn["meeting"], drawn["time"]) < MEETING_ROOM
    ),
    "too far": _too_far,
    "no way": _no_way,
    "out of reach": lambda _, drawn: ~drawn["reached"],
}
CAUSES = tuple(_APPLIES)


def first_cause(suite: Suite, drawn: dict[str, np.ndarray]) -> np.ndarray:
    """Place (B,) in `CAUSES` of the first one that applies; their number if none does."""
    cause = np.full(len(drawn["start"]), len(CAUSES))
    alive = np.arange(len(cause))
    for place, applies in enumerate(_APPLIES.values()):
        found = applies(suite, {name: leaf[alive] for name, leaf in drawn.items()})
        cause[alive[found]] = place
        alive = alive[~found]
    return cause
