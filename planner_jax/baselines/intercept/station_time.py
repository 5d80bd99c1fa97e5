"""The graph of station against time: what blocks a known way when, and lines through it.

A car follows a way whose length is known; the station is how far it has come. Obstacles that move
across the way block stations for some time: polygons in the plane of time and station [Qu2022,
Section IV-A]. Here are the problem, dynamic programming on a grid (eq. 17), and what lies beside
the line that it finds: free intervals at given times, and corridors of trapezoids (eq. 22).
"""

import dataclasses
from typing import Literal

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax


@struct.dataclass
class Blocked:
    """Up to P quadrangles in the plane of time and station, each between two upright sides.

    Parallel edges make them [Qu2022]'s parallelograms. An obstacle that blocks a bent way takes
    several.
    """

    start: Array  # (P,) [s], the left side
    end: Array  # (P,) [s], the right side, later than `start`
    lower: Array  # (P, 2) [m], the lower edge at `start` and at `end`
    upper: Array  # (P, 2) [m], the upper edge, above the lower one
    present: Array  # (P,) bool, which of the P there are

    def edges_at(self, time: Array) -> tuple[Array, Array]:
        """Stations (..., P) [m] of the lines of lower and upper edges at times (..., P) [s]."""
        share = (time - self.start) / (self.end - self.start)
        return (
            self.lower[..., 0] + share * (self.lower[..., 1] - self.lower[..., 0]),
            self.upper[..., 0] + share * (self.upper[..., 1] - self.upper[..., 0]),
        )


@struct.dataclass
class StationTimeProblem:
    """One problem: be at the end of a way at a given time, and never at a blocked station.

    The station is 0 at time 0 and never falls.
    """

    end_station: Array  # () [m], > 0, length of the way
    horizon: Array  # () [s], > 0, when to be at its end
    initial_speed: Array  # () [m/s]
    initial_acceleration: Array  # () [m/s^2]
    speed_limit: Array  # (L,) [m/s], on each of L equal parts of the way
    acceleration_limit: Array  # () [m/s^2], either sign
    blocked: Blocked


@dataclasses.dataclass(frozen=True)
class StationTimeGrid:
    """Size of the grid: speeds are multiples of its step in station by its step in time.

    A line rises by `stations / steps` steps in station a step in time on average, and by `jumps`
    at most.
    """

    stations: int = 60
    steps: int = 20
    jumps: int = 8


@struct.dataclass
class ReferenceLine:
    """What dynamic programming found: straight edges between equally spaced times."""

    station: Array  # (N + 1,) [m], at times 0, T / N, ..., T
    lower: Array  # (N + 1,) [m], from where on the stations around it are free at that time
    upper: Array  # (N + 1,) [m], up to where
    cost: Array  # () [m^2/s^3], its squared changes of speed by the time step, summed up
    found: Array  # () bool; without one the stations are those of even speed


def reference_line(
    problem: StationTimeProblem, grid: StationTimeGrid = StationTimeGrid()
) -> ReferenceLine:
    """The line of least acceleration through the free part of the graph [Qu2022, eq. 17].

    A node is a station at a time together with the edge that leads there, so that cost_edge can
    charge the squared change of speed from edge to edge. Nodes cost nothing. An edge that meets
    the inside of a polygon is forbidden, exactly and not only where the grid looks.
    """
    num, steps, jumps = grid.stations, grid.steps, range(grid.jumps + 1)
    station_step, step = problem.end_station / num, problem.horizon / steps
    speed = jnp.arange(grid.jumps + 1) * (station_step / step)

    def charge(before: Array) -> Array:
        """Cost of changing from speeds (...) to every speed, (J + 1, ...)."""
        change = (jnp.expand_dims(speed, range(1, 1 + before.ndim)) - before) / step
        is_allowed = jnp.abs(change) <= problem.acceleration_limit * (1.0 + 1e-5)
        return jnp.where(is_allowed, change**2 * step, jnp.inf)

    change = charge(speed)  # (to, from)
    toll = jnp.where(_closed_edges(problem, grid), jnp.inf, 0.0)  # (N, J + 1, S + 1)

    def arrived(leaving: Array) -> Array:
        """Costs (J + 1, S + 1) at the stations that jumps leave, as those where they arrive."""
        padded = jnp.pad(leaving, ((0, 0), (grid.jumps, 0)), constant_values=jnp.inf)
        return jnp.stack([padded[k, grid.jumps - k : grid.jumps - k + num + 1] for k in jumps])

    def advance(cost: Array, toll: Array) -> tuple[Array, Array]:
        leaving = cost[0] + change[:, :1]
        for k in jumps[1:]:
            leaving = jnp.minimum(leaving, cost[k] + change[:, k : k + 1])
        cost = arrived(leaving) + toll
        return cost, cost

    is_start = jnp.arange(num + 1) == 0
    first = jnp.where(is_start, charge(problem.initial_speed)[:, None], jnp.inf)
    first = arrived(first) + toll[0]
    last, before = lax.scan(lambda cost, toll: (advance(cost, toll)[0], cost), first, toll[1:])

    def back(node: tuple[Array, Array], cost: Array) -> tuple[tuple[Array, Array], Array]:
        """The node before, from the costs (J + 1, S + 1) of all that could be it."""
        jump, place = node
        place = place - jump
        jump = lax.argmin(cost[:, place] + change[jump], 0, jnp.int32)
        return (jump, place), place

    jump = lax.argmin(last[:, num], 0, jnp.int32)
    least = last[jump, num]
    found = jnp.isfinite(least)
    _, places = lax.scan(back, (jump, jnp.asarray(num, jnp.int32)), before, reverse=True)
    ends = jnp.asarray([0, num], places.dtype)
    places = jnp.concatenate([ends[:1], places, ends[1:]])
    even = jnp.linspace(0.0, 1.0, steps + 1) * problem.end_station
    station = jnp.where(found, places * station_step, even)
    lower, upper = free_intervals(problem, station, jnp.arange(steps + 1) * step)
    return ReferenceLine(station=station, lower=lower, upper=upper, cost=least, found=found)


def _closed_edges(problem: StationTimeProblem, grid: StationTimeGrid) -> Array:
    """Which edges are forbidden, (N, J + 1, S + 1) bool, by the jump and station they end with."""
    num, steps = grid.stations, grid.steps
    station_step, step = problem.end_station / num, problem.horizon / steps
    blocked = problem.blocked
    jump = jnp.arange(grid.jumps + 1)[:, None]
    station = jnp.arange(num + 1) * station_step

    # An edge passes by a polygon if at both ends of the time that they share it is below it, or at
    # both above. Either way that is a bound on the station with which it ends.
    end = (1.0 + jnp.arange(steps)[:, None, None]) * step
    begin, finish = jnp.maximum(end - step, blocked.start), jnp.minimum(end, blocked.end)
    rises = [(end - time) / step * jump * station_step for time in (begin, finish)]
    edges = [blocked.edges_at(time) for time in (begin, finish)]
    # Grid and polygons may have lines in common: touching is not meeting.
    slack = 1e-4 * station_step
    below = jnp.minimum(edges[0][0] + rises[0], edges[1][0] + rises[1]) + slack
    above = jnp.maximum(edges[0][1] + rises[0], edges[1][1] + rises[1]) - slack
    is_shared = (begin < finish) & blocked.present
    below, above = jnp.where(is_shared, below, jnp.inf), jnp.where(is_shared, above, -jnp.inf)
    is_met = (station > below[..., None]) & (station < above[..., None])

    # The least speed limit on the cells that an edge passes.
    limit = jnp.min(
        problem.speed_limit[_parts_of_cells(num, problem.speed_limit.shape[-1])], axis=1
    )
    least = [jnp.full(num + 1, jnp.inf, limit.dtype)]
    for k in range(1, grid.jumps + 1):
        cell = jnp.pad(limit, (k, 0), constant_values=jnp.inf)[: num + 1]
        least.append(jnp.minimum(least[-1], cell))
    is_fast = jump * (station_step / step) > jnp.stack(least) * (1.0 + 1e-5)
    return jnp.any(is_met, axis=2) | is_fast


def _parts_of_cells(num: int, parts: int) -> np.ndarray:
    """Which of equal parts of a way each of `num` equal cells of it touches, (num, W), repeated."""
    cell = np.arange(num)
    first, last = cell * parts // num, -(-(cell + 1) * parts // num) - 1
    width = (last - first).max() + 1
    return np.minimum(first[:, None] + np.arange(width), last[:, None])


def passed_above(problem: StationTimeProblem, station: Array) -> Array:
    """Which polygons (P,) a line (N + 1,) [m] at equally spaced times passes above: before them."""
    blocked = problem.blocked
    begin, finish = (jnp.clip(time, 0.0, problem.horizon) for time in (blocked.start, blocked.end))
    middle = 0.5 * (begin + finish)
    lower, upper = blocked.edges_at(middle)
    times = jnp.linspace(0.0, 1.0, station.shape[0]) * problem.horizon
    return jnp.interp(middle, times, station) > 0.5 * (lower + upper)


def free_intervals(
    problem: StationTimeProblem, station: Array, times: Array
) -> tuple[Array, Array]:
    """From which to which station (M,) [m] the graph is free at times (M,) [s] around a line.

    Args:
        problem: one problem.
        station: (N + 1,) [m], the line, at equally spaced times from 0 to the horizon.
        times: (M,) [s].
    """
    blocked = problem.blocked
    lower, upper = blocked.edges_at(times[:, None])
    is_now = (blocked.start <= times[:, None]) & (times[:, None] <= blocked.end) & blocked.present
    is_above = passed_above(problem, station)
    return (
        jnp.max(jnp.where(is_now & is_above, upper, 0.0), axis=1),
        jnp.min(jnp.where(is_now & ~is_above, lower, problem.end_station), axis=1),
    )


def stations_at_joints(station: Array, pieces: int) -> Array:
    """A line (N + 1,) [m] at equally spaced times, at the ends of equal pieces, (K + 1,) [m]."""
    times = jnp.linspace(0.0, 1.0, station.shape[-1])
    return jnp.interp(jnp.linspace(0.0, 1.0, pieces + 1), times, station)


@struct.dataclass
class Corridor:
    """Where a curve may be in each of K equal pieces of the horizon, around a line.

    A curve in it meets no polygon, and one that keeps to its speeds keeps to the speed limit of
    every part of the way. Each polygon has a line of its own in each piece, at an infinite station
    where it does not reach into the piece; with the two upright sides they bound trapezoids.
    """

    lower: Array  # (K, P) [m], lines to stay above, where the piece begins
    lower_rise: Array  # (K, P) [m], how much higher they are where it ends
    upper: Array  # (K, P) [m], lines to stay below
    upper_rise: Array  # (K, P) [m]
    floor: Array  # (K,) [m], below which the way has a lower speed limit than the piece
    ceiling: Array  # (K,) [m], above which it has
    speed: Array  # (K,) [m/s], greatest

    def bounds(self, shares: Array) -> tuple[Array, Array]:
        """Least and greatest stations [m] at shares (S,) of every piece, each (K, S)."""
        passed = shares[:, None]
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
    slope: Array | None = None,
) -> Corridor:
    """The corridor around a line that meets no polygon ([Qu2022, Section IV-C]; its ref. [17]).

    A piece that a polygon covers from begin to end is bounded by the polygon's edge. Of a polygon
    that begins or ends within the piece any line through its corner would do. The continued edge,
    which is the paper's choice, cuts off much of what is free; parallel to the curve that is
    looked for, a line cuts off next to nothing. The slope of the reference is close enough.

    Args:
        problem: one problem.
        station: (N + 1,) [m], the line, at equally spaced times from 0 to the horizon.
        pieces: K.
        lines: `tilted` as said; `edges` continues the polygon's edge; `flat` makes rectangles.
        slope: (K,) [m/s] for `tilted`, the mean speed expected in each piece; that of the line if
            left out.
    """
    blocked = problem.blocked
    length = problem.horizon / pieces
    joints = stations_at_joints(station, pieces)
    if slope is None:
        slope = (joints[1:] - joints[:-1]) / length
    start = (jnp.arange(pieces) * length)[:, None]
    begin, finish = jnp.maximum(start, blocked.start), jnp.minimum(start + length, blocked.end)
    is_met = (begin < finish) & blocked.present
    duration = jnp.where(is_met, finish - begin, 1.0)
    is_above = passed_above(problem, station)
    edges = zip(blocked.edges_at(begin), blocked.edges_at(finish), strict=True)
    (lower_edge, upper_edge) = edges
    at_begin, at_end = blocked.start <= start, blocked.end >= start + length

    def line(edge: tuple[Array, Array], side: float) -> tuple[Array, Array]:
        """A line beyond an edge on its upper side (1) or lower side (-1): head and rise."""
        own = (edge[1] - edge[0]) / duration
        if lines == "edges":
            chosen = own
        elif lines == "flat":
            chosen = jnp.zeros_like(own)
        else:
            # Where the edge reaches one end of the piece a line may only turn away from it there.
            wanted = side * slope[:, None]
            wanted = jnp.where(at_begin, jnp.minimum(wanted, side * own), wanted)
            wanted = jnp.where(at_end, jnp.maximum(wanted, side * own), wanted)
            chosen = side * wanted
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
    """Floor, ceiling and speed of every piece (K,), from a line's stations (K + 1,) at its joints.

    The speed is the least limit on the parts of the way that the line passes in the piece; floor
    and ceiling keep off parts with a limit below that.
    """
    limit = problem.speed_limit
    edge = jnp.linspace(0.0, 1.0, limit.shape[-1] + 1) * problem.end_station
    slack = 1e-6 * problem.end_station
    first, last = joints[:-1, None], joints[1:, None]
    is_passed = (edge[:-1] < last - slack) & (edge[1:] > first + slack)
    speed = jnp.min(jnp.where(is_passed, limit, jnp.inf), axis=1)
    # Standing still between two parts is passing none.
    speed = jnp.where(jnp.isfinite(speed), speed, jnp.min(limit))
    is_slower = (limit < speed[:, None]) & ~is_passed
    below, above = is_slower & (edge[1:] <= first + slack), is_slower & (edge[:-1] >= last - slack)
    return (
        jnp.max(jnp.where(below, edge[1:], -jnp.inf), axis=1),
        jnp.min(jnp.where(above, edge[:-1], jnp.inf), axis=1),
        speed,
    )
