"""Hybrid A*: a search for the path of a car that only drives forward among standing polygons.

The search runs over cells of position and heading, with one continuous state per cell, along arcs
that the car can drive [Dolgov2008]. It is the first half of the path planning of [Qu2022, Section
III-B]. Now and then, and more often near the goal, the search tries a Dubins path from a node to
the goal. It ends when no open node can lead to a cheaper path than the cheapest collision-free
Dubins path found; the paper takes the first one. The search runs on the host, one case at a time.
Its loops are compiled by numba, which the extra `baselines` installs. Positions are in the world
frame in the plane, in SI units, with headings counter-clockwise from the x axis.
"""

import dataclasses
import importlib
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike

from planner_jax.core.choices import require
from planner_jax.core.missing_extra import MissingExtra
from planner_jax.plane.obstacles import Obstacles

_DISCS = 3  # number of discs that cover the car's body


@dataclasses.dataclass(frozen=True)
class HybridAstar:
    """Settings of the search Hybrid A*.

    The cost of a path is its length plus a price for turns. The heuristic is the length of the
    shortest path without obstacles.
    """

    cell: float = 0.1  # [m], side of a square cell of the search grid
    headings: int = 72  # number of heading bins in a full turn
    turn_price: float = 0.05  # added cost [m] per metre driven at the greatest curvature
    # Weighted A* [Pohl1970]: the heuristic is multiplied by 1 + slack. The cost of a path is at
    # most this factor times the least cost of all paths that the search can represent.
    slack: float = 0.1
    margin: float = 0.01  # [m], least distance from polygons, since only samples are checked
    poses: int = 129  # number of poses of the resulting path
    max_expansions: int = 200_000  # number of expanded nodes after which the search gives up


@dataclasses.dataclass(frozen=True)
class HybridPath:
    """Path found by Hybrid A*; if none is found, arrays are NaN, and length and cost infinite.

    The poses are equally spaced along the path. The path consists of arcs and straight lines, so
    that the curvature jumps between poses.
    """

    poses: np.ndarray  # (N, 3) x, y [m] of the rear axle, heading [rad] without jumps of 2 pi
    curvature: np.ndarray  # (N,) [1/m], of the arc after each pose
    length: float  # [m]
    cost: float  # [m], length plus price of turns
    expansions: int  # number of expanded nodes
    found: bool
    blocked: bool  # whether the start pose, or every pose at the goal, collides


def hybrid_astar(
    start: ArrayLike,
    meeting: ArrayLike,
    walls: Obstacles,
    *,
    curvature: float,
    body: tuple[float, float, float],
    lower: ArrayLike,
    upper: ArrayLike,
    end_heading: float | None = None,
    settings: HybridAstar = HybridAstar(),
) -> HybridPath:
    """Search a path on which the body's centre of a car reaches the meeting point.

    The search tests three discs that cover the body, so that the body counts as wider and longer
    than it is. If the final heading is free, paths end with an arc and a straight line.

    Args:
        start: (3,) x, y [m] of the rear axle and heading [rad].
        meeting: (2,) [m], required position of the body's centre.
        walls: walls of one case; their velocities are ignored.
        curvature: [1/m], > 0, greatest curvature.
        body: [m], distances of the body's rear (negative) and front end ahead of the rear axle, and
            half of its width.
        lower: (2,) [m], least coordinates of the map, in which the body's centre must stay.
        upper: (2,) [m], greatest coordinates of the map.
        end_heading: [rad], final heading; None leaves it free.
        settings: settings of the search.

    Raises:
        ArgumentError: an argument or a setting is out of its range.
        MissingExtra: numba is not installed.
    """
    start, meeting, lower, upper = (np.array(x, np.float64) for x in (start, meeting, lower, upper))
    _require(start, meeting, lower, upper, curvature, body, end_heading, settings)
    kernels = _kernels()
    behind, ahead, half_width = map(float, body)
    middle, half = 0.5 * (behind + ahead), 0.5 * (ahead - behind) / _DISCS
    has_heading = end_heading is not None
    heading = float(end_heading or 0.0)
    direction = np.array([np.cos(heading), np.sin(heading)])
    position = meeting - middle * direction if has_heading else meeting
    positions = middle + half * np.arange(1.0 - _DISCS, _DISCS, 2.0)
    around = np.ceil(max(abs(middle), *abs(positions - middle)) / settings.cell + 0.5)
    corner = lower - around * settings.cell
    shape = np.ceil((upper - corner) / settings.cell + around).astype(int) + 1
    scene = kernels.Scene(
        polygons=np.array(walls.vertices(0.0), np.float64),
        present=np.array(walls.present, bool),
        lower=lower,
        upper=upper,
        middle=middle,
        offsets=positions,
        clear=float(np.hypot(half, half_width)) + settings.margin,
        corner=corner,
        shape=(int(shape[0]), int(shape[1])),
    )
    rules = kernels.Rules(
        curvature=float(curvature),
        cell=float(settings.cell),
        headings=settings.headings,
        price=float(settings.turn_price),
        slack=float(settings.slack),
        max_expansions=settings.max_expansions,
    )
    goal = kernels.Goal(np.append(position, heading), has_heading)
    node_of = np.zeros(int(shape.prod()) * settings.headings, np.int32)
    status, curvatures, lengths, cost, expansions = kernels.search(
        start, goal, scene, rules, node_of
    )
    poses, bends = _sample_arcs(start, curvatures, lengths, settings.poses)
    found = status == kernels.FOUND
    return HybridPath(
        poses=poses,
        curvature=bends,
        length=float(lengths.sum()) if found else np.inf,
        cost=float(cost),
        expansions=int(expansions),
        found=found,
        blocked=status == kernels.BLOCKED,
    )


def _kernels() -> ModuleType:
    try:
        return importlib.import_module("planner_jax.baselines.intercept.hybrid_astar_kernels")
    except ModuleNotFoundError as error:
        if error.name != "numba":
            raise
        raise MissingExtra("Hybrid A*, and so the planner paper,", "numba", "baselines") from None


def _require(start, meeting, lower, upper, curvature, body, end_heading, settings) -> None:
    points = {"meeting": (meeting, 2), "lower": (lower, 2), "upper": (upper, 2)}
    for name, (value, size) in ({"start": (start, 3)} | points).items():
        is_finite = value.shape == (size,) and np.isfinite(value).all()
        require(bool(is_finite), name, f"({size},) and finite", value)
    require(bool((upper > lower).all()), "upper", "> lower", shown=f"{upper} and {lower}")
    is_body = body[0] < body[1] and body[2] > 0.0
    require(bool(is_body), "body", "(behind, ahead > behind, half width > 0)", body)
    is_finite = end_heading is None or np.isfinite(end_heading)
    require(bool(is_finite), "end_heading", "finite", end_heading)
    chosen = {"curvature": curvature, **vars(settings)}
    for name in ("curvature", "cell", "max_expansions"):
        require(bool(0 < chosen[name] < np.inf), name, "> 0 and finite", chosen[name])
    for name in ("turn_price", "slack", "margin"):
        require(bool(0.0 <= chosen[name] < np.inf), name, ">= 0 and finite", chosen[name])
    for name, least in (("headings", 8), ("poses", 2)):
        require(chosen[name] >= least, name, f">= {least}", chosen[name])


def _sample_arcs(
    start: np.ndarray, curvatures: np.ndarray, lengths: np.ndarray, num: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sample `num` equally spaced poses (x, y, heading) and curvatures along a sequence of arcs."""
    if not len(lengths):
        return np.full((num, 3), np.nan), np.full(num, np.nan)
    ends = np.cumsum(lengths)
    heading = start[2] + np.append(0.0, np.cumsum(curvatures * lengths))
    steps = _chords(heading[:-1], curvatures, lengths)
    corners = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    stations = np.linspace(0.0, ends[-1], num)
    part = np.minimum(np.searchsorted(ends, stations, side="right"), len(ends) - 1)
    along = stations - np.append(0.0, ends)[part]
    positions = corners[part] + _chords(heading[part], curvatures[part], along)
    turned = heading[part] + curvatures[part] * along
    return np.concatenate([positions, turned[:, None]], axis=1), curvatures[part]


def _chords(heading: np.ndarray, curvature: np.ndarray, length: np.ndarray) -> np.ndarray:
    half = 0.5 * curvature * length
    chord = length * np.sinc(half / np.pi)
    return chord[..., None] * np.stack([np.cos(heading + half), np.sin(heading + half)], axis=-1)
