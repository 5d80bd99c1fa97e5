"""Searches for starting points of an interception: their settings, and the reach set of a case."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import Attempt
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.plane import cell_paths, reach
from planner_jax.plane.distance_field import DistanceField, distance_field
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.terms import discs_of, wrap

# Memory of a path, and of a word of a reach set, in units of a start of a planner of few unknowns.
_PATH_STARTS = 8
_WORD_STARTS = 1 / 32768
_FIELD = 128  # nodes of the distance field along either side of the map


@dataclasses.dataclass(frozen=True)
class Search(Attempt):
    """An attempt at a case: random paths, and least squares from each; static."""

    starts: int = dataclasses.field(init=False, default=1)
    paths: int = 16  # number of paths
    solver: LevenbergConfig = LevenbergConfig()  # of the stage that meets all limits
    following: int = 4  # steps of the stage that follows the path of cells
    settling: int = 16  # steps of the last stage, towards less effort or an earlier meeting
    margin: float = 0.03  # [m], distance from obstacles at which hinges start
    slack: float = 0.015  # hinges start at (1 - slack) times a limit
    discs: int = 3  # that cover the body in least squares
    seed: int = 0  # of the paths
    candidates: int = 4  # paths that are drawn for each path; the smoothest is used
    directness: float = 2.0  # of paths; see `cell_paths.draw_path`
    lattice: reach.Lattice = reach.Lattice()
    # Factor on the body's radius in the reach set. Below 1 it admits paths that the rounding to
    # cells closes.
    body_scale: float = 1.0

    def __post_init__(self) -> None:
        if self.paths < 1:
            raise ArgumentError("paths", ">= 1", self.paths)
        lattice = self.lattice
        words = lattice.cells**2 // 32 * lattice.levels * lattice.headings * lattice.layers
        starts = max(_PATH_STARTS * self.paths, round(_WORD_STARTS * words))
        object.__setattr__(self, "starts", starts)

    def draw_noise(self) -> cell_paths.PathNoise:
        """Draw the noise of every path; leaves have a leading axis for the paths."""
        return cell_paths.draw_noise(self.lattice, self.paths, self.seed, self.candidates)


@dataclasses.dataclass(frozen=True)
class Warm(Attempt):
    """An attempt at re-planning: least squares from the remainder of the previous plan; static."""

    solver: LevenbergConfig = LevenbergConfig(8)
    settling: int = 4  # this and the other fields are as in `Search`
    margin: float = 0.03
    slack: float = 0.015
    discs: int = 3


_GIVEN = (
    Search(2, LevenbergConfig(10), following=3),
    Search(4, LevenbergConfig(16), seed=1, body_scale=0.9),
    Search(16, LevenbergConfig(24), seed=2, body_scale=0.75, candidates=1, directness=0.0),
)
QUICK = tuple(
    dataclasses.replace(search, paths=paths, solver=LevenbergConfig(steps), settling=12)
    for search, paths, steps in zip(_GIVEN, (2, 4, 6), (8, 10, 14), strict=True)
)
# For a car that starts beside a wall: many paths with almost no margin.
_NARROW = tuple(
    Search(64, LevenbergConfig(60), seed=seed, body_scale=girth, margin=0.006, slack=1e-3, discs=7)
    for seed, girth in ((3, 0.9), (4, 0.75), (6, 0.9))
)
BEST = (dataclasses.replace(_GIVEN[0], paths=8, settling=48), *_GIVEN[1:], *_NARROW)
# If the time is free, least squares run from every path until they improve little, and the best
# plan is selected. Meetings are earlier if no stage follows the cells.
_EARLY = Search(
    32,
    LevenbergConfig(60, tolerance=5e-4),
    following=0,
    body_scale=0.85,
    candidates=1,
    directness=0.0,
)
_LEAST = Search(16, LevenbergConfig(60, tolerance=5e-4))
_LATER = (
    Search(8, seed=1, body_scale=0.9),
    dataclasses.replace(_GIVEN[2], solver=LevenbergConfig(30)),
)
SEARCHES = {
    "given": _GIVEN,
    "early": (_EARLY, *_LATER),
    "least": (_LEAST, *_LATER),
}


@struct.dataclass
class Reachability:
    """The grid, the distance field and the reach set of a case, which all its paths share."""

    grid: reach.Grid
    field: DistanceField  # of the walls
    reach: reach.ReachSet
    layers: Array  # (layers + 1,) bool, layers at which a path of cells meets the target

    @property
    def is_reached(self) -> Array:
        """True if a path of cells meets the target, () bool."""
        return jnp.any(self.layers)


def make_grid(case: InterceptCase, lattice: reach.Lattice) -> reach.Grid:
    """Make the grid of cells and layers of a case."""
    return reach.grid_of(lattice, case.start, case.time, case.limits.speed, case.lower, case.upper)


def make_field(case: InterceptCase, grid: reach.Grid) -> DistanceField:
    """Compute the distances from the walls, at one or more nodes for each cell."""
    spacing = grid.cell * (grid.lattice.cells / _FIELD)
    return distance_field(case.walls, grid.corner, spacing, _FIELD)


def search_reach(
    case: InterceptCase, search: Search, *, is_time_free: bool, layers: Array | None = None
) -> Reachability:
    """Compute the reach set of a case, by default for the layers up to the case's time.

    `is_time_free` is true if earlier layers may meet the target.
    """
    grid = make_grid(case, search.lattice)
    field = make_field(case, grid)
    radius, ahead = discs_of(case.body, 2)
    level = case.limits.speed * jnp.linspace(0.0, 1.0, search.lattice.levels)
    turn_rates = jnp.minimum(
        case.limits.curvature * level,
        case.limits.lateral_acceleration / jnp.maximum(level, 0.1 * case.limits.speed),
    )
    vehicle = reach.Vehicle(
        radius=search.body_scale * radius,
        ahead=ahead,
        speed=case.limits.speed,
        turn_rates=turn_rates,
    )
    needed = grid.num if layers is None else layers
    by = _FIELD // search.lattice.cells
    coarse = field.values[::by, ::by]
    found = reach.reach_set(grid, coarse, case.movers, vehicle, case.speed, needed)
    numbers = jnp.arange(search.lattice.layers + 1)
    num = grid.num.astype(numbers.dtype)
    is_met = jax.vmap(lambda n: jnp.any(_meeting_cells(case, grid, found, n)[1]))
    if is_time_free:
        reached = is_met(numbers) & (numbers >= 1) & (numbers <= num)
    else:
        reached = is_met(grid.num[None])[0] & (numbers == num)
    return Reachability(grid=grid, field=field, reach=found, layers=reached)


def _meeting_cells(
    case: InterceptCase, grid: reach.Grid, found: reach.ReachSet, layer: Array
) -> tuple[Array, Array]:
    """Return the cells of a layer at which the target is met; see `reach.goal_cells`."""
    goal = case.target.at((layer.astype(grid.step.dtype) + 0.5) * grid.step).pos
    num = grid.lattice.headings
    width = 2.0 * np.pi / num
    angle = grid.heading + width * jnp.arange(num, dtype=grid.heading.dtype)
    headings = jnp.abs(wrap(angle - case.end_heading)) <= case.heading_tolerance + width
    return reach.goal_cells(grid, found.bits[layer], goal, case.body.middle, headings)


def draw_cell_path(
    case: InterceptCase,
    found: Reachability,
    layer: Array,
    noise: cell_paths.PathNoise,
    directness: float,
) -> cell_paths.CellPath:
    """Draw a random path of cells that meets the target at a layer () int32."""
    cells, is_reached = _meeting_cells(case, found.grid, found.reach, layer)
    draw = cell_paths.draw_path
    return draw(found.grid, found.reach, layer, cells, is_reached, noise, directness)


# All values are explicit: published cases depend on them.
_ARRIVAL = Search(paths=1, lattice=reach.Lattice(64, 30, 4, 32, 6.0), body_scale=1.0)


def earliest_arrival(case: InterceptCase) -> Array:
    """Return the time () [s] of the first layer of a reach set that meets one case's target; pure.

    The layers are about half a second apart if the case's time is 10 s. The result is infinite if
    no layer up to that time meets the target. No path is drawn, and nothing is optimised.
    """
    found = search_reach(case, _ARRIVAL, is_time_free=True)
    first = jnp.argmax(found.layers).astype(case.time.dtype)
    return jnp.where(found.is_reached, (first + 0.5) * found.grid.step, jnp.inf)
