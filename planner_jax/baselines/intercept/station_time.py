"""The station-time graph of a path: which stations are blocked when, and lines through the graph.

A car follows a path of known length; its station is the distance travelled along the path.
Obstacles that cross the path block stations for some time, that is polygons in the plane of time
and station [Qu2022, Section IV-A]. This module contains the problem, dynamic programming on a grid,
which finds a line between the polygons (eq. 17), and bounds beside this line (eq. 22).
"""

import dataclasses
from typing import Literal

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax


@struct.dataclass
class Blocked:
    """Up to P quadrangles in the plane of time and path length that obstacles block.

    A quadrangle has vertical sides at two times. An obstacle has several quadrangles if the path is
    curved.
    """

    start: Array  # (P,) [s], time of the left side
    end: Array  # (P,) [s], time of the right side, later than `start`
    lower: Array  # (P, 2) [m], the lower edge at `start` and at `end`
    upper: Array  # (P, 2) [m], the upper edge, above the lower edge
    present: Array  # (P,) bool, which of the P quadrangles are used

    def edges_at(self, time: Array) -> tuple[Array, Array]:
        """Return the stations [m] of the lower and upper edges of P quadrangles at times [s].

        `time` and both results have the shape (..., P).
        """
        lead = range(time.ndim - 1)
        start, end, lower, upper = (
            jnp.expand_dims(each, lead) for each in (self.start, self.end, self.lower, self.upper)
        )
        share = (time - start) / (end - start)
        return (
            lower[..., 0] + share * (lower[..., 1] - lower[..., 0]),
            upper[..., 0] + share * (upper[..., 1] - upper[..., 0]),
        )


@struct.dataclass
class StationTimeProblem:
    """The problem of reaching a path's end at a given time without entering a blocked station.

    The station is the distance along the path. It is 0 at time 0 and never decreases.
    """

    end_station: Array  # () [m], > 0, length of the path
    horizon: Array  # () [s], > 0, when the car must be at the end
    initial_speed: Array  # () [m/s]
    initial_acceleration: Array  # () [m/s^2]
    speed_limit: Array  # (L,) [m/s], on each of L equal parts of the path
    acceleration_limit: Array  # () [m/s^2], either sign
    blocked: Blocked


@dataclasses.dataclass(frozen=True)
class StationTimeGrid:
    """Size of the grid of dynamic programming: path and horizon are divided into equal steps."""

    stations: int = 60  # number of station steps
    steps: int = 20  # number of time steps
    jumps: int = 8  # greatest number of station steps in one time step


@struct.dataclass
class ReferenceLine:
    """The line of station (distance along a path) over time that dynamic programming finds."""

    station: Array  # (N + 1,) [m], at equally spaced times from 0 to the horizon
    cost: Array  # () [m^2/s^3], sum of (change of speed)^2 / (time step)
    found: Array  # () bool; if False, the stations are the line of constant speed


def reference_line(
    problem: StationTimeProblem, grid: StationTimeGrid = StationTimeGrid()
) -> ReferenceLine:
    """Return the line of least acceleration that enters no blocked polygon [Qu2022, eq. 17].

    A state of the search is a path length (station) at a time, together with the edge that leads to
    this station, so that the squared change of speed between two edges is a cost. An edge that
    enters a polygon is forbidden.
    """
    num, steps, jumps = grid.stations, grid.steps, range(grid.jumps + 1)
    station_step, step = problem.end_station / num, problem.horizon / steps
    speed = jnp.arange(grid.jumps + 1) * (station_step / step)

    def charge(before: Array) -> Array:
        change = (jnp.expand_dims(speed, range(1, 1 + before.ndim)) - before[None]) / step
        is_allowed = jnp.abs(change) <= problem.acceleration_limit * (1.0 + 1e-5)
        return jnp.where(is_allowed, change**2 * step, jnp.inf)

    change = charge(speed)  # (new speed, old speed)
    penalty = jnp.where(_find_forbidden_edges(problem, grid), jnp.inf, 0.0)  # (N, J + 1, S + 1)

    def shift_to_end(leaving: Array) -> Array:
        padded = jnp.pad(leaving, ((0, 0), (grid.jumps, 0)), constant_values=jnp.inf)
        return jnp.stack([padded[k, grid.jumps - k : grid.jumps - k + num + 1] for k in jumps])

    def advance(cost: Array, penalty: Array) -> tuple[Array, Array]:
        leaving = cost[None, 0] + change[:, :1]
        for k in jumps[1:]:
            leaving = jnp.minimum(leaving, cost[None, k] + change[:, k : k + 1])
        cost = shift_to_end(leaving) + penalty
        return cost, cost

    is_start = jnp.arange(num + 1) == 0
    first = jnp.where(is_start, charge(problem.initial_speed)[:, None], jnp.inf)
    first = shift_to_end(first) + penalty[0]
    last, before = lax.scan(
        lambda cost, penalty: (advance(cost, penalty)[0], cost), first, penalty[1:]
    )

    def step_back(node: tuple[Array, Array], cost: Array) -> tuple[tuple[Array, Array], Array]:
        jump, place = node
        place = place - jump
        jump = lax.argmin(cost[:, place] + change[jump], 0, jnp.int32)
        return (jump, place), place

    jump = lax.argmin(last[:, num], 0, jnp.int32)
    least = last[jump, num]
    found = jnp.isfinite(least)
    _, places = lax.scan(step_back, (jump, jnp.asarray(num, jnp.int32)), before, reverse=True)
    ends = jnp.asarray([0, num], places.dtype)
    places = jnp.concatenate([ends[:1], places, ends[1:]])
    even = jnp.linspace(0.0, 1.0, steps + 1) * problem.end_station
    station = jnp.where(found, places * station_step, even)
    return ReferenceLine(station=station, cost=least, found=found)


def _find_forbidden_edges(problem: StationTimeProblem, grid: StationTimeGrid) -> Array:
    """Return which edges of the grid enter a polygon or exceed a speed limit, as a mask.

    The axes are the time step of the edge, its rise in station steps, and the station of its end.
    """
    num, steps = grid.stations, grid.steps
    station_step, step = problem.end_station / num, problem.horizon / steps
    blocked = problem.blocked
    jump = jnp.arange(grid.jumps + 1)[:, None]
    station = (jnp.arange(num + 1) * station_step)[None, None, None]

    # An edge passes a polygon if it is below the polygon at both ends of their common time, or
    # above it at both ends. Each condition is a bound on the station at which the edge ends.
    end = (1.0 + jnp.arange(steps)[:, None, None]) * step
    begin = jnp.maximum(end - step, blocked.start[None, None])
    finish = jnp.minimum(end, blocked.end[None, None])
    rises = [(end - time) / step * jump[None] * station_step for time in (begin, finish)]
    edges = [blocked.edges_at(time) for time in (begin, finish)]
    # Grid lines may coincide with polygon edges; touching an edge is allowed.
    slack = 1e-4 * station_step
    below = jnp.minimum(edges[0][0] + rises[0], edges[1][0] + rises[1]) + slack
    above = jnp.maximum(edges[0][1] + rises[0], edges[1][1] + rises[1]) - slack
    is_shared = (begin < finish) & blocked.present[None, None]
    below, above = jnp.where(is_shared, below, jnp.inf), jnp.where(is_shared, above, -jnp.inf)
    is_met = (station > below[..., None]) & (station < above[..., None])

    # Least speed limit on the part of the path that an edge of the grid passes.
    limit = jnp.min(
        problem.speed_limit[_parts_of_cells(num, problem.speed_limit.shape[-1])], axis=1
    )
    least = [jnp.full(num + 1, jnp.inf, limit.dtype)]
    for k in range(1, grid.jumps + 1):
        cell = jnp.pad(limit, (k, 0), constant_values=jnp.inf)[: num + 1]
        least.append(jnp.minimum(least[-1], cell))
    is_fast = jump * (station_step / step) > jnp.stack(least) * (1.0 + 1e-5)
    return jnp.any(is_met, axis=2) | is_fast[None]


def _parts_of_cells(num: int, parts: int) -> np.ndarray:
    cell = np.arange(num)
    first, last = cell * parts // num, -(-(cell + 1) * parts // num) - 1
    width = (last - first).max() + 1
    return np.minimum(first[:, None] + np.arange(width), last[:, None])


def is_passed_above(problem: StationTimeProblem, station: Array) -> Array:
    """Return whether a line of path length over time passes above each of P polygons, (P,) bool.

    Above a polygon means that the car passes before the obstacle. The line has the stations
    `station` (N + 1,) [m] at equally spaced times.
    """
    blocked = problem.blocked
    begin, finish = (jnp.clip(time, 0.0, problem.horizon) for time in (blocked.start, blocked.end))
    middle = 0.5 * (begin + finish)
    lower, upper = blocked.edges_at(middle)
    times = jnp.linspace(0.0, 1.0, station.shape[0]) * problem.horizon
    return jnp.interp(middle, times, station) > 0.5 * (lower + upper)


def stations_at_joints(station: Array, pieces: int) -> Array:
    """Interpolate the stations of a line at the ends of K = `pieces` equal time intervals.

    The given and returned stations, (N + 1,) and (K + 1,) [m], are at equally spaced times.
    """
    times = jnp.linspace(0.0, 1.0, station.shape[-1])
    return jnp.interp(jnp.linspace(0.0, 1.0, pieces + 1), times, station)


@struct.dataclass
class Corridor:
    """Bounds on path length (station) over time, in each of K equal time intervals (pieces).

    A curve within the bounds enters none of P polygons. If it also keeps `speed`, it keeps the
    speed limit of every part of the path. Each polygon is a straight lower or upper bound in each
    piece. A bound is infinite if the polygon does not overlap the piece.
    """

    lower: Array  # (K, P) [m], lower bounds at the start of the piece
    lower_rise: Array  # (K, P) [m], rise of the lower bounds over the piece
    upper: Array  # (K, P) [m], upper bounds at the start of the piece
    upper_rise: Array  # (K, P) [m], rise of the upper bounds over the piece
    floor: Array  # (K,) [m], below it the path has a lower speed limit than the piece
    ceiling: Array  # (K,) [m], above it the path has a lower speed limit than the piece
    speed: Array  # (K,) [m/s], greatest speed in the piece

    def bounds(self, shares: Array) -> tuple[Array, Array]:
        """Return least and greatest stations (K, S) [m] at S positions: fractions of each piece."""
        passed = shares[None, :, None]
        lower = self.lower[:, None] + passed * self.lower_rise[:, None]
        upper = self.upper[:, None] + passed * self.upper_rise[:, None]
        return (
            jnp.maximum(jnp.max(lower, axis=2), self.floor[:, None]),
            jnp.minimum(jnp.min(upper, axis=2), self.ceiling[:, None]),
        )


def corridor(
    problem: StationTimeProblem,
    station: Array,
    pieces: int,
    lines: Literal["tilted", "edges", "flat"] = "tilted",
) -> Corridor:
    """Return bounds on path lengths beside a line that enters no polygon [Qu2022, Section IV-C].

    Time is divided into equal pieces. If a polygon covers the whole duration of a piece, the
    polygon's edge is the bound. If a polygon starts or ends within the piece, the bound is a line
    through the polygon's corner. The paper continues the edge, which excludes much free space.

    Args:
        problem: one problem.
        station: (N + 1,) [m], the line, at equally spaced times from 0 to the horizon.
        pieces: number of pieces.
        lines: slope of the bounds: "tilted", of the line `station` unless the bound would then
            enter the polygon; "edges", of the polygon's edge; "flat", 0.
    """
    blocked = problem.blocked
    length = problem.horizon / pieces
    joints = stations_at_joints(station, pieces)
    slope = (joints[1:] - joints[:-1]) * pieces / problem.horizon
    start = (jnp.arange(pieces) * length)[:, None]
    begin = jnp.maximum(start, blocked.start[None])
    finish = jnp.minimum(start + length, blocked.end[None])
    is_met = (begin < finish) & blocked.present[None]
    duration = jnp.where(is_met, finish - begin, 1.0)
    is_above = is_passed_above(problem, station)[None]
    edges = zip(blocked.edges_at(begin), blocked.edges_at(finish), strict=True)
    (lower_edge, upper_edge) = edges
    at_begin, at_end = blocked.start[None] <= start, blocked.end[None] >= start + length

    def line(edge: tuple[Array, Array], side: float) -> tuple[Array, Array]:
        own = (edge[1] - edge[0]) / duration
        if lines == "edges":
            chosen = own
        elif lines == "flat":
            chosen = jnp.zeros_like(own)
        else:
            turned = side * slope[:, None]
            turned = jnp.where(at_begin, jnp.minimum(turned, side * own), turned)
            turned = jnp.where(at_end, jnp.maximum(turned, side * own), turned)
            chosen = side * turned
        heads = [edge[0] + chosen * (start - begin), edge[1] + chosen * (start - finish)]
        return side * jnp.maximum(side * heads[0], side * heads[1]), chosen * length

    lower, lower_rise = line(upper_edge, 1.0)
    upper, upper_rise = line(lower_edge, -1.0)
    floor, ceiling, speed = _speed_limits(problem, joints)
    return Corridor(
        lower=jnp.where(is_met & is_above, lower, -jnp.inf),
        lower_rise=jnp.where(is_met & is_above, lower_rise, 0.0),
        upper=jnp.where(is_met & ~is_above, upper, jnp.inf),
        upper_rise=jnp.where(is_met & ~is_above, upper_rise, 0.0),
        floor=floor,
        ceiling=ceiling,
        speed=speed,
    )


def _speed_limits(problem: StationTimeProblem, joints: Array) -> tuple[Array, Array, Array]:
    """Return bounds on the station [m] and a speed limit [m/s] for each of K time intervals.

    No part of the path between a lower and an upper bound has a lower speed limit. `joints`
    (K + 1,) [m] are the stations of a line at the ends of the intervals.
    """
    limit = problem.speed_limit
    edge = jnp.linspace(0.0, 1.0, limit.shape[-1] + 1)[None] * problem.end_station
    left, right = edge[:, :-1], edge[:, 1:]
    slack = 1e-6 * problem.end_station
    first, last = joints[:-1, None], joints[1:, None]
    is_passed = (left < last - slack) & (right > first + slack)
    speed = jnp.min(jnp.where(is_passed, limit, jnp.inf), axis=1)
    # A line that stands still on the border of two path parts passes no part: take the least limit.
    speed = jnp.where(jnp.isfinite(speed), speed, jnp.min(limit))
    is_slower = (limit[None] < speed[:, None]) & ~is_passed
    below, above = is_slower & (right <= first + slack), is_slower & (left >= last - slack)
    return (
        jnp.max(jnp.where(below, right, -jnp.inf), axis=1),
        jnp.min(jnp.where(above, left, jnp.inf), axis=1),
        speed,
    )
