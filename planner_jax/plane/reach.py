"""Where a car can be, and when: a reach set in space and time, one bit a cell.

A layer of the set holds, for every level of speed, every heading and every cell of a square grid,
one bit: whether the car can be there at that layer's time, among obstacles that stand and move. At
a layer the speed changes by a level at most, and the heading by some bins; up to the next one the
car moves on straight, as it does for half as long before the first layer. Path and time are
searched together, so that a car can wait for an obstacle to pass, or be there before it. One set
holds all paths round the obstacles, all headings and all meeting times; `cell_paths` draws paths
from it.

The cells of a row are the bits of words, so that a move is a choice of rows and a shift. The result
is coarse: an optimiser starts from it.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.plane.obstacles import Obstacles, distances

_STENCIL = 32  # cells along either side of what is drawn of one moving obstacle
_FARTHEST = 16  # cells that the car moves in half a layer, at most
SPAN = 3  # bins of heading to either side that a layer may turn, at most


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Lattice:
    """Sizes of a reach set."""

    cells: int = 64  # along either side of the grid, a multiple of 32
    layers: int = 30  # in time, at most
    levels: int = 4  # of speed, with standing
    headings: int = 32
    pace: float = 6.0  # cells that the car moves in a layer at its greatest speed


@struct.dataclass
class Grid:
    """The positions of the cells and the times of the layers of one case."""

    lattice: Lattice = struct.field(pytree_node=False)
    lower: Array  # (2,) [m], corner of the map, which the vehicle's middle does not leave
    upper: Array  # (2,) [m], opposite corner
    corner: Array  # (2,) [m], middle of the cell (0, 0)
    cell: Array  # () [m]
    step: Array  # () [s], from layer to layer; layer n is at (n + 1/2) steps
    num: Array  # () int32, the layer at the horizon
    start: Array  # (2,) int32, the cell of the start
    heading: Array  # () [rad], of bin 0: that of the start


@struct.dataclass
class Vehicle:
    """A vehicle on the grid: a reference point with two discs that cover the body."""

    radius: Array  # () [m], of the discs
    ahead: Array  # (2,) [m], of their middles from the reference point
    speed: Array  # () [m/s], the greatest
    turn_rates: Array  # (levels,) [rad/s], the greatest at each level of speed


@struct.dataclass
class ReachSet:
    """The bits of all layers, and the moves and turns between layers."""

    bits: Array  # (layers + 1, words, levels, headings, cells) uint32; rows are y, bits x
    moves: Array  # (layers, levels, headings, 2, 2) int32, cells [x, y] in either half of a step
    turns: Array  # (layers, levels, 2 SPAN + 1) bool, which turns a level of speed allows


def grid_of(
    lattice: Lattice, start: Array, time: Array, speed: Array, lower: Array, upper: Array
) -> Grid:
    """Make the grid of a map for a horizon.

    Args:
        lattice: sizes.
        start: (3,) x, y [m] and heading [rad]; a cell of the grid.
        time: () [s], the horizon: the time of the last layer.
        speed: () [m/s], the greatest.
        lower: (2,) [m], corner of the map.
        upper: (2,) [m], opposite corner.
    """
    cell = jnp.max(upper - lower) / lattice.cells
    paces = jnp.floor(time * speed / (lattice.pace * cell) - 0.5 + 1e-3)
    num = jnp.clip(paces, 1, lattice.layers)
    step = time / (num + 0.5)
    offset = jnp.round((start[:2] - lower) / cell - 0.5)
    return Grid(
        lattice=lattice,
        lower=lower,
        upper=upper,
        corner=start[:2] - cell * offset,
        cell=cell,
        step=step,
        num=num.astype(jnp.int32),
        start=offset.astype(jnp.int32),
        heading=start[2],
    )


def _packed(cells: Array) -> Array:
    """Pack cells (..., W * 32) bool into words (W, ...)."""
    bits = cells.reshape(*cells.shape[:-1], -1, 32).astype(jnp.uint32)
    words = jnp.sum(bits << jnp.arange(32, dtype=jnp.uint32), axis=-1, dtype=jnp.uint32)
    return jnp.moveaxis(words, -1, 0)


def _along_y(rows: Array, move: Array) -> Array:
    """Move rows (words, ..., cells) uint32 by up to `_FARTHEST` cells; drop cells off the grid."""
    words, cells = rows.shape[0], rows.shape[-1]
    padded = jnp.pad(rows.reshape(words, -1, cells), ((0, 0), (0, 0), (_FARTHEST, _FARTHEST)))
    moved = jax.vmap(
        lambda row, by: lax.dynamic_slice_in_dim(row, _FARTHEST - by, cells, axis=1),
        in_axes=(1, 0),
        out_axes=1,
    )(padded, move.reshape(-1))
    return moved.reshape(rows.shape)


def _along_x(rows: Array, move: Array) -> Array:
    """Move bits (words, ..., cells) by (...) cells, under 32; those off the grid are dropped."""
    none = jnp.zeros_like(rows[0])
    by = jnp.abs(move[..., None]).astype(jnp.uint32)
    carry = (32 - by) & 31
    some, right = by > 0, move[..., None] >= 0
    moved = []
    for word, before, after in zip(rows, [none, *rows[:-1]], [*rows[1:], none], strict=True):
        up = (word << by) | jnp.where(some, before >> carry, 0)
        down = (word >> by) | jnp.where(some, after << carry, 0)
        moved.append(jnp.where(right, up, down))
    return jnp.stack(moved)


def _shifted(rows: Array, move: Array) -> Array:
    """Move cells (words, ..., cells) by (..., 2) [x, y]; those off the grid are dropped."""
    return _along_x(_along_y(rows, move[..., 1]), move[..., 0])


def _of_each(body: Callable[[Array], Array], over: Array, needed: Array) -> Array:
    """Map a function over the first `needed` entries.

    On a CPU this is a loop, so that each result is stored before it is used.
    """

    def looped(over: Array, needed: Array) -> Array:
        one = jax.eval_shape(body, over[0])
        made = jnp.zeros((over.shape[0], *one.shape), one.dtype)
        return lax.fori_loop(0, needed, lambda k, made: made.at[k].set(body(over[k])), made)

    return lax.platform_dependent(
        over, needed, cpu=looped, default=lambda over, _: jax.vmap(body)(over)
    )


def _stencils(grid: Grid, movers: Obstacles, radius: Array) -> Array:
    """Return rows of bits around the middle of every moving obstacle, (M, _STENCIL) uint32."""
    place = grid.cell * (jnp.arange(_STENCIL, dtype=grid.corner.dtype) - _STENCIL // 2)
    x, y = jnp.meshgrid(place, place)
    far, _ = distances(movers.corners, movers.present, x.reshape(1, -1), y.reshape(1, -1))
    return _packed((far < radius).reshape(-1, _STENCIL, _STENCIL))[0]


def _blocked_by(grid: Grid, movers: Obstacles, stencils: Array, time: Array) -> Array:
    """Return the cells that moving obstacles take at one time, (words, cells) uint32."""
    cells = grid.lattice.cells
    middle = (movers.centre + movers.velocity * time - grid.corner) / grid.cell
    at = jnp.round(jnp.clip(middle, -cells, 2.0 * cells)).astype(jnp.int32) - _STENCIL // 2

    def of_one(stencil: Array, at: Array) -> Array:
        y = jnp.arange(cells) - at[1]
        row = jnp.where(
            (y >= 0) & (y < _STENCIL), stencil[jnp.clip(y, 0, _STENCIL - 1)], jnp.uint32(0)
        )
        words = [_word_of(row, at[0] - 32 * word) for word in range(cells // 32)]
        return jnp.stack(words)

    return lax.reduce(
        jax.vmap(of_one)(stencils, at), jnp.uint32(0), lax.bitwise_or, dimensions=(0,)
    )


def _word_of(row: Array, at: Array) -> Array:
    """Return the bits of one word in a row of 32 bits that starts at an index."""
    by = jnp.minimum(jnp.abs(at), 31).astype(jnp.uint32)
    moved = jnp.where(at >= 0, row << by, row >> by)
    return jnp.where(jnp.abs(at) < 32, moved, jnp.uint32(0))


def reach_set(
    grid: Grid,
    field: Array,
    movers: Obstacles,
    vehicle: Vehicle,
    initial_speed: Array,
    needed: Array,
) -> ReachSet:
    """Compute the reach set of a vehicle.

    Args:
        grid: of `grid_of`.
        field: (cells, cells) [m], distance of every cell's middle from the walls; rows are y.
        movers: moving obstacles.
        vehicle: sizes and limits.
        initial_speed: () [m/s].
        needed: () int32, number of layers to compute; the same for all cases of a batch.
    """
    lattice, speed = grid.lattice, vehicle.speed
    levels, headings, num_cells = lattice.levels, lattice.headings, lattice.cells
    dtype = grid.corner.dtype
    width = 2.0 * np.pi / headings
    angle = grid.heading + width * jnp.arange(headings, dtype=dtype)
    direction = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    pace = speed * grid.step / grid.cell * jnp.arange(levels, dtype=dtype) / (levels - 1)
    # Whole cells from layer to layer, so that the sum of n layers is n moves, rounded: to round
    # each alone would turn a heading of 11 degrees into 0.
    passed = jnp.arange(2 * lattice.layers + 2, dtype=dtype)[:, None, None, None]
    cells = jnp.round(0.5 * passed * pace[:, None, None] * direction).astype(jnp.int32)
    halves = jnp.diff(cells, axis=0)  # (2 layers + 1, levels, headings, 2)
    halves = jnp.clip(halves, -_FARTHEST, _FARTHEST)
    moves = jnp.moveaxis(halves[1:].reshape(-1, 2, levels, headings, 2), 1, 3)
    most = vehicle.turn_rates * grid.step / width
    # Whole bins in each layer, so that they add up to what the turn rates allow.
    before = jnp.arange(lattice.layers + 1, dtype=dtype)[:, None]
    whole = jnp.diff(jnp.floor(before * most + 0.1), axis=0)  # (layers, levels)
    span = jnp.abs(jnp.arange(-SPAN, SPAN + 1))
    turns = span <= whole[..., None]
    walls = _packed(field < vehicle.radius)
    stencils = _stencils(grid, movers, vehicle.radius)
    discs = jnp.round(-vehicle.ahead[:, None, None] * direction / grid.cell).astype(jnp.int32)
    middle = jnp.mean(vehicle.ahead) * direction  # of the body from the rear axle
    place = grid.corner[:, None] + grid.cell * jnp.arange(num_cells, dtype=dtype)
    on_map = (place + middle[:, :, None] > grid.lower[:, None]) & (
        place + middle[:, :, None] < grid.upper[:, None]
    )
    columns = _packed(on_map[:, 0])[..., None]
    allowed = jnp.where(on_map[:, 1], columns, jnp.uint32(0))

    times = 0.5 * grid.step * jnp.arange(2 * lattice.layers + 2, dtype=dtype)
    halves_needed = 2 * needed + 2

    def blocked_at(time: Array) -> Array:
        """Return the cells that an obstacle takes, (words, cells)."""
        return walls | _blocked_by(grid, movers, stencils, time)

    blocked = _of_each(blocked_at, times, halves_needed)

    def free_of(blocked: Array) -> Array:
        """Return where the rear axle can be with every heading, (words, headings, cells)."""
        each = jnp.broadcast_to(blocked[:, None], (num_cells // 32, headings, num_cells))
        return allowed & ~(_shifted(each, discs[0]) | _shifted(each, discs[1]))

    free = _of_each(free_of, blocked, halves_needed)  # at every half layer

    def along_y(bits: Array, n: Array, half: int) -> Array:
        moved = _along_y(bits[:, 1:], moves[n, 1:, :, half, 1])
        return jnp.concatenate([bits[:, :1], moved], axis=1)

    def along_x(bits: Array, n: Array, half: int) -> Array:
        moved = _along_x(bits[:, 1:], moves[n, 1:, :, half, 0])
        moved = jnp.concatenate([bits[:, :1], moved], axis=1)
        return moved & free[2 * n + half + 2][:, None]

    parts = [
        lambda bits, n: _faster_or_slower(bits),
        lambda bits, n: _turned(bits, turns[n]),
        *(functools.partial(move, half=half) for half in range(2) for move in (along_y, along_x)),
    ]

    def apart(bits: Array, n: Array) -> Array:
        """Compute one layer, each part in a loop of its own.

        A compiler for CPUs that fuses the parts computes the first again for every bit that the
        next one reads.
        """
        return lax.fori_loop(0, len(parts), lambda k, bits: lax.switch(k, parts, bits, n), bits)

    def at_once(bits: Array, n: Array) -> Array:
        for part in parts:
            bits = part(bits, n)
        return bits

    def layer(n: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        bits, layers = state
        bits = lax.platform_dependent(bits, n, cpu=apart, default=at_once)
        return bits, lax.dynamic_update_index_in_dim(layers, bits, n + 1, 0)

    first = _start_bits(grid, initial_speed, speed)
    first = _shifted(first & free[0][:, None], halves[0]) & free[1][:, None]
    layers = jnp.zeros((lattice.layers + 1, *first.shape), first.dtype).at[0].set(first)
    _, layers = lax.fori_loop(0, needed, layer, (first, layers))
    return ReachSet(bits=layers, moves=moves, turns=turns)


def _start_bits(grid: Grid, initial_speed: Array, speed: Array) -> Array:
    """Return the first layer: the levels of speed next to the vehicle's own."""
    lattice, cell = grid.lattice, grid.start
    level = initial_speed / speed * (lattice.levels - 1)
    near = jnp.abs(jnp.arange(lattice.levels) - level) < 1.0
    place = jnp.arange(lattice.cells)
    at = (place[:, None] == cell[1]) & (place == cell[0])
    here = near[:, None, None] & (jnp.arange(lattice.headings) == 0)[:, None]
    return jnp.where(here, _packed(at)[:, None, None], jnp.uint32(0))


def _faster_or_slower(bits: Array) -> Array:
    """Add the cells of the neighbouring levels to every level of speed."""
    none = jnp.zeros_like(bits[:, :1])
    slower = jnp.concatenate([bits[:, 1:], none], axis=1)
    return bits | slower | jnp.concatenate([none, bits[:, :-1]], axis=1)


def _turned(bits: Array, turns: Array) -> Array:
    """Add the cells of the headings from which the car can turn to every heading."""
    found = jnp.zeros_like(bits)
    for k in range(2 * SPAN + 1):
        by = jnp.roll(bits, k - SPAN, axis=2)
        found |= jnp.where(turns[:, k, None, None], by, jnp.uint32(0))
    return found


def bit_at(bits: Array, level: Array, heading: Array, cell: Array) -> Array:
    """Return whether a layer (words, levels, headings, cells) holds a cell (2,) [x, y]."""
    _, levels, headings, cells = bits.shape
    inside = jnp.all((cell >= 0) & (cell < cells)) & (level >= 0) & (level < levels)
    x, y = jnp.clip(cell, 0, cells - 1)
    word = bits[x // 32, jnp.clip(level, 0, levels - 1), heading % headings, y]
    return inside & (((word >> (x % 32).astype(jnp.uint32)) & 1) > 0)


def goal_cells(
    grid: Grid, layer: Array, goal: Array, ahead: Array, headings: Array
) -> tuple[Array, Array]:
    """Return the cells of a layer at a goal.

    Args:
        grid: of the reach set.
        layer: (words, levels, headings, cells) uint32.
        goal: (2,) [m].
        ahead: () [m], from the rear axle to the point that meets the goal.
        headings: (headings,) bool, which are allowed.

    Returns:
        cells: (headings, 9, 2) int32, around the goal.
        is_there: (levels, headings, 9) bool.
    """
    lattice = grid.lattice
    width = 2.0 * np.pi / lattice.headings
    bins = jnp.arange(lattice.headings)
    angle = grid.heading + width * bins.astype(grid.cell.dtype)
    axle = goal - ahead * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    nearest = jnp.round((axle - grid.corner) / grid.cell).astype(jnp.int32)
    around = np.stack(np.meshgrid([0, -1, 1], [0, -1, 1]), axis=-1).reshape(-1, 2)
    cells = nearest[:, None] + around
    of_level = jax.vmap(jax.vmap(bit_at, (None, None, None, 0)), (None, None, 0, 0))
    there = jax.vmap(of_level, (None, 0, None, None))(
        layer, jnp.arange(lattice.levels), bins, cells
    )
    return cells, there & headings[:, None]
