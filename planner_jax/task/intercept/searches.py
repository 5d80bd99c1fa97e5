"""Searches for starting points of an interception: their settings, and the reach set of a case.

The reach set (`plane.reach`) holds one bit for every cell, heading, speed and time: whether the car
can be there. Random paths through the set are the starting points of least squares.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.core import Tracer

from planner_jax.core.choices import require
from planner_jax.core.compiled import cached_by_precision, with_run_time_numbers
from planner_jax.core.protocol import BaseAttempt
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.plane import cell_paths, reach
from planner_jax.plane.distance_field import DistanceField, distance_field
from planner_jax.plane.target import rotate
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.problem.clearance import (
    discs_of,
    inside_map,
    nearest_in_region,
    wrap,
)

# Estimated memory of a search for each path, and for each 32-bit word of the bits that mark the
# reachable cells. The unit is the memory of one starting point of the library's other planners.
_PATH_STARTS = 8
_WORD_STARTS = 1 / 32768
_PADDED = ("paths", "candidates")
_NODES = 2  # nodes of the grid of distances from walls for each cell, along both axes


@dataclasses.dataclass(frozen=True)
class Search(BaseAttempt):
    """An attempt to plan a case by least squares from random paths of reachable grid cells."""

    starts: int = dataclasses.field(init=False, default=1)
    paths: int = 16  # number of paths from which least squares run
    solver: LevenbergConfig = LevenbergConfig()  # settings of the stage that meets all limits
    following: int = 4  # number of steps of the first stage, which follows the path of cells
    settling: int = 16  # number of steps of the last stage, which reduces the cost
    margin: float = 0.03  # [m], distance from obstacles below which they are penalised
    slack: float = 0.015  # a value is penalised above (1 - slack) times its limit
    discs: int = 3  # number of discs that cover the car's body in least squares
    seed: int = 0  # seed of the random paths
    candidates: int = 4  # number of random paths of which the smoothest is used as one path
    directness: float = 2.0  # preference for straight paths; see `cell_paths.draw_path`
    lattice: reach.Lattice = reach.Lattice()
    # Factor on the body's radius when the reach set (the cells that the car can reach) is computed.
    # The set is conservative, as obstacles are rounded to whole cells. A factor below 1 admits
    # narrow passages that are open in truth.
    body_scale: float = 1.0
    body_discs: int = 2  # number of discs that cover the body in the reach set
    # Number of states that are continued after each step of a search for motions (`state_paths`),
    # from which least squares start instead of paths of cells; 0: paths of cells.
    states: int = 0
    # Whether least squares also start from the direct motion to the target (`guess_directly`).
    is_direct: bool = False
    # Whether the search is left out if the cells of the default lattice are small enough.
    is_for_small_cars: bool = False
    # Whether all paths are tried and the best plan is selected, instead of the first solved plan.
    # If the meeting time is free, all paths are always tried.
    tries_all: bool = False
    # Whether the meeting is at the latest time until all limits are kept, although it may be early.
    is_late: bool = False

    def __post_init__(self) -> None:
        require(self.paths >= 1, "paths", ">= 1", self.paths)
        lattice = self.lattice
        columns, rows = lattice.cells
        words = columns // 32 * rows * lattice.num_speeds * lattice.headings * lattice.layers
        starts = max(_PATH_STARTS * self.paths, round(_WORD_STARTS * words))
        object.__setattr__(self, "starts", starts)


@with_run_time_numbers(
    *("paths", "following", "settling", "margin", "slack", "directness", "body_scale"),
    *("noise", "is_last", "is_direct", "is_late", "tries_all"),
)
@dataclasses.dataclass(frozen=True)
class LoadedSearch(Search):
    """A `Search` whose settings are arrays, so that several searches share a compiled program."""

    _: dataclasses.KW_ONLY
    noise: cell_paths.PathNoise  # random numbers that select each path
    is_last: bool  # whether the planner makes no later search with the same lattice

    def __post_init__(self) -> None:
        """Skip the checks of `Search`, which were made when the search was created."""


@cached_by_precision
def load_search(
    search: Search, searches: tuple[Search, ...], is_apart: bool, has_reverse: bool
) -> LoadedSearch:
    """Return one of a planner's searches, with its settings as arguments of a compiled program.

    All `searches` of the planner with equal lattices and numbers of states share one program. Its
    arrays of random numbers, which select the paths, are padded to the greatest numbers of paths
    and candidates of these searches. If `is_apart`, the search has its own program without
    padding, because a GPU would try padded paths, too. `has_reverse` is whether the car has a
    reverse gear.
    """
    same = [
        each for each in searches if each.lattice == search.lattice and each.states == search.states
    ]
    is_last = search == same[-1]
    sizes = (search,) if is_apart else same
    if has_reverse:
        lattice = search.lattice
        lattice = dataclasses.replace(lattice, reverse_levels=lattice.levels - 1)
        search = dataclasses.replace(search, lattice=lattice)
    paths, candidates = (max(vars(each)[name] for each in sizes) for name in _PADDED)
    noise = cell_paths.draw_noise(search.lattice, search.paths, search.seed, search.candidates)
    path = np.minimum(np.arange(paths), search.paths - 1)
    candidate = np.arange(candidates) % search.candidates
    noise = cell_paths.PathNoise(
        layers=noise.layers[path],
        ends=noise.ends[path][:, candidate],
        steps=noise.steps[path][:, candidate],
    )
    fields = dict(vars(search))
    del fields["starts"]
    fields |= {"seed": 0, "candidates": candidates, "within": None, "improves": False}
    return LoadedSearch(**fields, noise=noise, is_last=is_last)


@dataclasses.dataclass(frozen=True)
class Warm(BaseAttempt):
    """Settings of re-planning, in which least squares start from the previous plan's remainder."""

    solver: LevenbergConfig = LevenbergConfig(8)
    settling: int = 4  # number of steps of the last stage; all fields are as in `Search`
    margin: float = 0.03
    slack: float = 0.015
    discs: int = 3


_GIVEN = (
    Search(2, LevenbergConfig(10), following=3, settling=40, is_direct=True),
    Search(4, LevenbergConfig(16), seed=1, body_scale=0.9),
    Search(16, LevenbergConfig(24), seed=2, body_scale=0.75, candidates=1, directness=0.0),
    # For cars that cannot keep a large distance from an obstacle or a limit.
    Search(16, LevenbergConfig(60), seed=3, body_scale=0.8, margin=0.006, slack=1e-3),
)
# Search for cars that are small in comparison with the distance to the target, such as cars on
# roads. Its cells are small, and four discs cover the body closely.
_FINE = Search(
    16,
    LevenbergConfig(60),
    following=16,
    seed=5,
    body_scale=0.9,
    body_discs=4,
    discs=5,
    margin=0.01,
    slack=5e-3,
    is_for_small_cars=True,
    lattice=reach.Lattice((256, 192), layers=60, levels=8, pace=5.0),
)
# Last search, for cases that least squares from paths of cells do not solve.
_STATES = Search(
    16,
    LevenbergConfig(60),
    following=0,
    body_scale=0.6,
    candidates=1,
    discs=5,
    margin=0.006,
    slack=1e-3,
    states=1000,
)
_COARSE = 0.6  # a cell that is longer than this share of the car's width is coarse
QUICK = tuple(
    dataclasses.replace(search, paths=paths, solver=LevenbergConfig(steps), settling=12)
    for search, paths, steps in zip(_GIVEN[:3], (2, 4, 6), (8, 10, 14), strict=True)
)
# Last attempts of the effort "best", for cars that start close to a wall and cannot keep a large
# distance from it: many paths, and penalties only at small distances from obstacles.
NARROW = tuple(
    Search(64, LevenbergConfig(60), seed=seed, body_scale=girth, margin=0.006, slack=1e-3, discs=7)
    for seed, girth in ((3, 0.9), (4, 0.75), (6, 0.9))
)
# First search if the meeting shall be as early as possible: least squares run from every path until
# the cost falls by less than 0.05 % a step, and the best plan is selected. There is no first stage
# (`following`), because following a path of grid cells delays the meeting.
_EARLY = Search(
    32,
    LevenbergConfig(60, tolerance=5e-4),
    following=0,
    body_scale=0.85,
    candidates=1,
    directness=0.0,
    is_direct=True,
)
_LEAST = Search(16, LevenbergConfig(60, tolerance=5e-4), is_direct=True)
# Later searches for a free meeting time first find a plan for the latest time, and then improve it.
_LATER = tuple(dataclasses.replace(each, is_late=True) for each in (*_GIVEN, _FINE, _STATES))
SEARCHES = {
    "given": (*_GIVEN, _FINE, _STATES),
    "early": (_EARLY, *_LATER),
    "least": (_LEAST, *_LATER),
}


def choose_searches(searches: tuple[Search, ...], cases: InterceptCase) -> tuple[Search, ...]:
    """Leave out searches that the cases do not need.

    Searches for small cars are left out if the usual cells are small enough for all cases.
    Searches of states are left out if a car has a reverse gear. Both are left out inside compiled
    functions, since they would more than double the compile time.
    """
    usual = reach.Lattice().cells
    leaves = (cases.lower, cases.upper, cases.limits.speed, cases.time, cases.body.width)
    is_coarse, is_traced = False, any(isinstance(leaf, Tracer) for leaf in leaves)
    if not is_traced:
        lower, upper, speed, time, width = (np.asarray(leaf, np.float64) for leaf in leaves)
        cell = np.minimum(upper - lower, 2.0 * (speed * time)[..., None]) / np.asarray(usual)
        is_coarse = bool(np.any(cell > _COARSE * width[..., None]))
    omits_states = is_traced or cases.limits.reverse_speed is not None
    small = (each for each in searches if is_coarse or not each.is_for_small_cars)
    return tuple(each for each in small if not (each.states and omits_states))


@struct.dataclass
class Reachability:
    """Grid and reachable cells (reach set): the data to draw paths from."""

    grid: reach.Grid
    reach: reach.ReachSet
    layers: Array  # (layers + 1,) bool, whether the car can meet the target at each layer in time

    @property
    def is_reached(self) -> Array:
        """True if the car can meet the target along a path of reachable grid cells, () bool."""
        return jnp.any(self.layers)


def make_grid(case: InterceptCase, lattice: reach.Lattice, *, is_time_free: bool) -> reach.Grid:
    """Return the grid of a case: cells that cover the part of its map that the car can use.

    The part is bounded by ellipses: a car whose path has the length L visits only points whose
    distances from the start and from the target add up to at most L.

    Args:
        case: the case.
        lattice: numbers of the grid's cells, times, speeds and headings.
        is_time_free: whether the target may be met before the case's time.
    """
    speed = _top_speed(case)
    share = jnp.linspace(0.125, 1.0, 8) if is_time_free else jnp.ones(1)
    times = share.astype(speed.dtype) * case.time
    goals = jax.vmap(lambda time: case.target.at(time).pos)(times) - case.start[None, :2]
    around = jnp.sqrt(jnp.max(jnp.sum(case.region**2, axis=1))) + case.body.length
    apart = jnp.sqrt(jnp.sum(goals**2, axis=1))
    length = jnp.maximum(speed * times, apart) + 2.0 * around
    half = 0.5 * jnp.sqrt(length[:, None] ** 2 - goals[:, ::-1] ** 2)
    lowest = case.start[:2] + jnp.min(0.5 * goals - half, axis=0)
    highest = case.start[:2] + jnp.max(0.5 * goals + half, axis=0)
    corners = _map_corners(case, jnp.max(length))
    lower, upper = (edge(corners, axis=0) for edge in (jnp.min, jnp.max))
    lower, upper = jnp.maximum(lower, lowest), jnp.minimum(upper, highest)
    size = jnp.maximum(upper - lower, 4.0 * case.body.length)
    middle = 0.5 * (lower + upper)
    lower, upper = middle - 0.5 * size, middle + 0.5 * size
    return reach.grid_of(lattice, case.start, case.time, speed, lower, upper)


def _top_speed(case: InterceptCase) -> Array:
    """Return the greatest speed () in any gear that the car can reach by the case's time."""
    gained = jnp.abs(case.speed) + jnp.minimum(case.limits.acceleration, 1e6) * case.time
    most = jnp.maximum(case.limits.speed, -case.limits.least_speed)
    return jnp.minimum(most, jnp.maximum(gained, 1e-3))


def _map_corners(case: InterceptCase, reach: Array) -> Array:
    """Return the corners (4, 2) of the map; the map is cut at the distance `reach` of the start."""
    start = rotate(case.start[:2], -case.map_heading)
    lower = jnp.maximum(case.lower, start - reach)
    upper = jnp.minimum(case.upper, start + reach)
    x, y = (jnp.stack([lower[k], upper[k]]) for k in range(2))
    corners = jnp.stack([jnp.repeat(x, 2), jnp.tile(y, 2)], axis=1)
    return rotate(corners, case.map_heading)


def make_field(case: InterceptCase, grid: reach.Grid) -> DistanceField:
    """Compute the distances [m] from the walls at two nodes for each cell along both axes."""
    columns, rows = grid.lattice.cells
    half = 1.0 / _NODES
    return distance_field(
        case.walls, grid.corner, half * grid.cell, (_NODES * columns, _NODES * rows)
    )


def search_reach(
    case: InterceptCase,
    search: Search,
    grid: reach.Grid,
    field: DistanceField,
    *,
    is_time_free: bool,
    layers: Array | None = None,
) -> Reachability:
    """Compute which cells the car can reach at which times, and when it can meet the target.

    `grid` and `field` are the results of `make_grid` and `make_field`. `layers` is the number of
    equally spaced times; by default they extend to the case's time. `is_time_free` is true if the
    target may be met before the case's time.
    """
    found = compute_reach(case, search, grid, field, grid.num if layers is None else layers)
    numbers = jnp.arange(grid.lattice.layers + 1)
    num = grid.num.astype(numbers.dtype)
    meet = functools.partial(_meeting_cells, case, grid)
    is_met = jax.vmap(lambda n: jnp.any(meet(found.bits[n], found.speeds, n)[1]))
    if is_time_free:
        times = (numbers.astype(grid.step.dtype) + 0.5) * grid.step
        reached = is_met(numbers) & (numbers >= 1) & (numbers <= num) & (times >= case.earliest)
    else:
        reached = is_met(grid.num[None])[0] & (numbers == num)
    return Reachability(grid=grid, reach=found, layers=reached)


def compute_reach(
    case: InterceptCase,
    search: Search,
    grid: reach.Grid,
    field: DistanceField,
    needed: Array,
    is_backward: bool = False,
) -> reach.ReachSet:
    """Compute the states that the car can reach, as `search_reach` does.

    With `is_backward` the result has the states from which the car can meet the target at the
    case's time, and layer 0 is at this time.
    """
    lattice, limits, speed = search.lattice, case.limits, _top_speed(case)
    radius, ahead = discs_of(case.body, search.body_discs)
    shares = [
        jnp.linspace(0.0, 1.0, num + 1) for num in (lattice.reverse_levels, lattice.levels - 1)
    ]
    backward, forward = (
        jnp.minimum(speed, most) * share
        for most, share in zip((-limits.least_speed, limits.speed), shares, strict=True)
    )
    level = jnp.concatenate([-backward[:0:-1], forward])
    quickest = limits.lateral_acceleration / jnp.maximum(jnp.abs(level), 0.1 * speed)
    turn_rates = jnp.minimum(limits.curvature * jnp.abs(level), quickest)
    vehicle = reach.Vehicle(
        search.body_scale * radius + case.margin, ahead, level, turn_rates, limits.acceleration
    )
    coarse = field.values[::_NODES, ::_NODES]
    allowed = _allowed_cells(case, grid)
    goal = None
    if is_backward:
        goal = _mark_goal(case, grid, level)
        vehicle = dataclasses.replace(vehicle, speeds=-level)
    return reach.reach_set(grid, coarse, allowed, case.movers, vehicle, case.speed, needed, goal)


def _mark_goal(case: InterceptCase, grid: reach.Grid, speeds: Array) -> Array:
    """Return the states that meet the target at the horizon, bool, as `reach.reach_set` needs."""
    lattice = grid.lattice
    columns, rows = lattice.cells
    every = jnp.full((columns // 32, speeds.size, lattice.headings, rows), 2**32 - 1, jnp.uint32)
    cells, is_met = _meeting_cells(case, grid, every, speeds, grid.num)
    column, row = jnp.moveaxis(cells, -1, 0)
    bins = jnp.arange(lattice.headings)[:, None]
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    at = bins, jnp.clip(row, 0, rows - 1), jnp.clip(column, 0, columns - 1)
    none = jnp.zeros((lattice.headings, rows, columns), bool)
    return jax.vmap(lambda met: none.at[at].max(met & inside))(is_met)


def _allowed_cells(case: InterceptCase, grid: reach.Grid) -> Array:
    """Return the cells in which the body's middle is on the map, (headings, rows, columns) bool."""
    lattice = grid.lattice
    bins = jnp.arange(lattice.headings, dtype=grid.cell.dtype)
    angle = grid.heading + (2.0 * np.pi / lattice.headings) * bins
    middle = case.body.middle * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    x, y = (
        grid.corner[k] + grid.cell[k] * jnp.arange(lattice.cells[k], dtype=grid.cell.dtype)
        for k in range(2)
    )
    cells = jnp.stack(jnp.meshgrid(x, y), axis=-1)
    return inside_map(case, cells[None] + middle[:, None, None]) > 0.0


def _meeting_cells(
    case: InterceptCase, grid: reach.Grid, bits: Array, speeds: Array, layer: Array
) -> tuple[Array, Array]:
    goal = case.target.at((layer.astype(grid.step.dtype) + 0.5) * grid.step).pos
    num = grid.lattice.headings
    width = 2.0 * np.pi / num
    angle = grid.heading + width * jnp.arange(num, dtype=grid.heading.dtype)
    headings = jnp.abs(wrap(angle - case.end_heading)) <= case.heading_tolerance + width
    # Of a region around the target, 9 points are tried: those nearest to a grid of 3 x 3 points.
    extent = jnp.max(jnp.abs(case.region), axis=0)
    grid_points = jnp.asarray(reach.AROUND, extent.dtype) * extent[None]
    away, _ = jax.vmap(nearest_in_region, (None, 0))(case.region, grid_points)
    points = goal[None] + grid_points - away
    cells, is_reached = reach.goal_cells(grid, bits, points, case.body.middle, headings)
    gap = jnp.max(jnp.diff(speeds))
    levels = (speeds > case.end_speed[0] - gap) & (speeds < case.end_speed[1] + gap)
    return cells, is_reached & levels[:, None, None]


def draw_cell_path(
    case: InterceptCase,
    found: Reachability,
    layer: Array,
    noise: cell_paths.PathNoise,
    directness: Array | float,
) -> cell_paths.CellPath:
    """Draw a random path of grid cells that meets the target at the time of index `layer` ().

    `noise` holds the random numbers that select the path. The greater `directness` >= 0, the
    straighter are the paths, and the more even is their speed.
    """
    reached = found.reach
    meetings = _meeting_cells(case, found.grid, reached.bits[layer], reached.speeds, layer)
    return cell_paths.draw_path(found.grid, reached, layer, *meetings, noise, directness)


# Settings of `earliest_arrival`. They do not use the defaults of `Search`, because the cases of the
# suite `rush` depend on these values and must not change if a default changes.
_ARRIVAL = Search(paths=1, lattice=reach.Lattice((64, 64), 30, 4, 32, 6.0), body_scale=1.0)


def earliest_arrival(case: InterceptCase) -> Array:
    """Estimate the earliest time () [s] at which the car of one case can meet its target.

    The estimate is the first time in the reach set (about 20 times up to 10 s) at which the car can
    be at the target; infinite if there is none up to the case's time. Nothing is optimised.
    """
    # The speed may change by one level at any time, as if the acceleration had no limit.
    unlimited = dataclasses.replace(case.limits, acceleration=jnp.full_like(case.time, jnp.inf))
    case = dataclasses.replace(case, limits=unlimited)
    whole = case.start, case.time, case.limits.speed, case.lower, case.upper
    grid = reach.grid_of(_ARRIVAL.lattice, *whole)
    found = search_reach(case, _ARRIVAL, grid, make_field(case, grid), is_time_free=True)
    first = jnp.argmax(found.layers).astype(case.time.dtype)
    return jnp.where(found.is_reached, (first + 0.5) * found.grid.step, jnp.inf)
