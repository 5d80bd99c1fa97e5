"""The set of states that a car can reach among obstacles, on a grid in space and time.

Planners of interceptions (a car meets a moving target) start from coarse paths in this reach set.
The set has one layer for each of several equally spaced times. A layer has one bit for every speed
level, every heading bin and every cell of a rectangular grid. The bit tells whether the car can be
there at that time without touching a standing or moving obstacle. At a layer the speed changes by
at most one level, and the heading by a few bins. Between layers, and for half a step before the
first layer, the car moves straight on.

Path and timing are searched together, so that a car can wait for an obstacle to pass, or pass
before it. One set covers all paths around the obstacles, all headings and all meeting times.
`cell_paths` draws paths from the set.

The bits of a row of cells (equal y) are packed in 32-bit words. A motion of the car along y moves
whole rows, and a motion along x shifts the bits of the words.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.plane.obstacles import Obstacles, distances, place

_STENCIL = 32  # number of cells along each side of the bitmap of one moving obstacle
_FARTHEST = 16  # greatest number of cells that the car moves in half a step between layers
AROUND = np.stack(np.meshgrid([0, -1, 1], [0, -1, 1]), axis=-1).reshape(-1, 2)  # 3 x 3 steps
SPAN = 3  # greatest number of heading bins by which the car turns at one layer, to either side


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Lattice:
    """The sizes of a reach set: its numbers of cells, time layers, speed levels and headings."""

    cells: tuple[int, int] = (64, 64)  # numbers of cells along x, a multiple of 32, and y
    layers: int = 30  # greatest number of layers in time
    levels: int = 4  # number of speed levels from standstill to the greatest speed
    headings: int = 32  # number of heading bins in one revolution
    pace: float = 6.0  # number of cells along x between two layers at the greatest speed
    reverse_levels: int = 0  # number of speed levels in reverse, below standstill

    @property
    def num_speeds(self) -> int:
        """Number of all speed levels, in both gears."""
        return self.reverse_levels + self.levels


@struct.dataclass
class Grid:
    """The grid of a set of reachable states: positions of its cells, and times of its layers."""

    lattice: Lattice = struct.field(pytree_node=False)
    corner: Array  # (2,) [m], middle of the cell (0, 0)
    cell: Array  # (2,) [m], side lengths of a cell along x and y
    step: Array  # () [s], time between two layers; layer n is at the time (n + 1/2) * step
    num: Array  # () int32, index of the layer at the horizon
    start: Array  # (2,) int32, indices [x, y] of the cell at the start
    heading: Array  # () [rad], heading of bin 0, which is the heading at the start


@struct.dataclass
class Vehicle:
    """Sizes and limits of a vehicle, whose body is covered by discs."""

    radius: Array  # () [m], radius of the discs
    ahead: Array  # (discs,) [m], distances of the discs' middles ahead of the rear axle
    # Speeds of the levels, increasing, with one standstill. The levels of each gear are equally
    # spaced; negative speeds are in reverse.
    speeds: Array  # (levels,) [m/s]
    turn_rates: Array  # (levels,) [rad/s], greatest turn rate at each level of speed
    acceleration: Array  # () [m/s^2], greatest acceleration; inf: any change by one level


@struct.dataclass
class ReachSet:
    """The states that a car can reach at equally spaced times (layers), and its possible steps."""

    # Bitmaps of the reachable states, (layers + 1, words, levels, headings, cells) uint32. Here and
    # below, "levels" stands for the number of all speed levels, in both gears. The last
    # axis is over cells along y. The bits of the words on the second axis are cells along x.
    bits: Array
    # (layers, levels, headings, 2, 2) int32. The last axis is the number of cells along x and y
    # that the car moves. The axis before it is the first or second half of the time step.
    moves: Array
    turns: Array  # (layers, levels, 2 SPAN + 1) bool, allowed turns at each level of speed
    changes: Array  # (layers,) bool, whether the speed may change by one level at this layer
    speeds: Array  # (levels,) [m/s], speeds of the levels


def grid_of(
    lattice: Lattice, start: Array, time: Array, speed: Array, lower: Array, upper: Array
) -> Grid:
    """Make the grid of cells and time layers for a map and a planning horizon.

    The car starts in the middle of a cell, and the last time layer is at the horizon.

    Args:
        lattice: numbers of cells, time layers, speed levels and headings.
        start: (3,) x, y [m] and heading [rad] of the car at time 0.
        time: () [s], the horizon, the latest time of the plan.
        speed: () [m/s], greatest speed of the car.
        lower: (2,) [m], corner of the region that the grid covers.
        upper: (2,) [m], opposite corner.
    """
    cell = (upper - lower) / jnp.asarray(lattice.cells, upper.dtype)
    paces = jnp.floor(time * speed / (lattice.pace * cell[0]) - 0.5 + 1e-3)
    num = jnp.clip(paces, 1, lattice.layers)
    step = time / (num + 0.5)
    offset = jnp.round((start[:2] - lower) / cell - 0.5)
    return Grid(
        lattice=lattice,
        corner=start[:2] - cell * offset,
        cell=cell,
        step=step,
        num=num.astype(jnp.int32),
        start=offset.astype(jnp.int32),
        heading=start[2],
    )


def _pack(cells: Array) -> Array:
    """Pack bools (..., W * 32) into the bits of W 32-bit words, an array (W, ...) uint32."""
    bits = cells.reshape(*cells.shape[:-1], -1, 32).astype(jnp.uint32)
    shifts = jnp.expand_dims(jnp.arange(32, dtype=jnp.uint32), tuple(range(cells.ndim)))
    return jnp.moveaxis(jnp.sum(bits << shifts, axis=-1, dtype=jnp.uint32), -1, 0)


def _move_y(rows: Array, move: Array) -> Array:
    """Shift bitmaps of cells by `move` (...) cells along y, the last axis of the bitmaps."""
    words, cells = rows.shape[0], rows.shape[-1]
    padded = jnp.pad(rows.reshape(words, -1, cells), ((0, 0), (0, 0), (_FARTHEST, _FARTHEST)))
    move_row = lambda row, by: lax.dynamic_slice_in_dim(row, _FARTHEST - by, cells, 1)  # noqa: E731
    moved = jax.vmap(move_row, in_axes=(1, 0), out_axes=1)(padded, move.reshape(-1))
    return moved.reshape(rows.shape)


def _move_x(rows: Array, move: Array) -> Array:
    """Shift bitmaps of cells by `move` (...) < 32 cells along x, the bits of 32-bit words."""
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


def _shift(rows: Array, move: Array) -> Array:
    return _move_x(_move_y(rows, move[..., 1]), move[..., 0])


def _map_needed(body: Callable[[Array], Array], over: Array, needed: Array) -> Array:
    def loop(over: Array, needed: Array) -> Array:
        one = jax.eval_shape(body, over[0])
        results = jnp.zeros((over.shape[0], *one.shape), one.dtype)
        return lax.fori_loop(0, needed, lambda k, done: done.at[k].set(body(over[k])), results)

    return lax.platform_dependent(
        over, needed, cpu=loop, default=lambda over, _: jax.vmap(body)(over)
    )


def _stencils(grid: Grid, movers: Obstacles, radius: Array, time: Array) -> Array:
    """Return bitmaps of the cells around each mover in which a disc touches it at one time () [s].

    The result (N, 32) has words of 32 cells along x, one for each of 32 cells along y.
    """
    steps = jnp.arange(_STENCIL, dtype=grid.corner.dtype) - _STENCIL // 2
    x, y = (
        each.reshape(1, -1) for each in jnp.meshgrid(grid.cell[0] * steps, grid.cell[1] * steps)
    )
    placed = place(movers, time[None])
    none = jnp.zeros_like(placed.x)
    local = dataclasses.replace(placed, x=none, y=none).enter(x, y)
    far, _ = distances(movers.corners, placed.present, *local)
    touches = far < radius + placed.radius
    return _pack(touches.reshape(-1, _STENCIL, _STENCIL))[0]


def _draw_movers(grid: Grid, movers: Obstacles, stencils: Array, time: Array) -> Array:
    columns, rows = grid.lattice.cells
    most = jnp.asarray(grid.lattice.cells, grid.cell.dtype)[None]
    placed = place(movers, time[None])
    middle = (jnp.concatenate([placed.x, placed.y], axis=1) - grid.corner[None]) / grid.cell[None]
    at = jnp.round(jnp.clip(middle, -most, 2.0 * most)).astype(jnp.int32) - _STENCIL // 2

    def draw_one(stencil: Array, at: Array) -> Array:
        y = jnp.arange(rows, dtype=at.dtype) - at[1]
        inside = (y >= 0) & (y < _STENCIL)
        row = jnp.where(inside, stencil[jnp.clip(y, 0, _STENCIL - 1)], jnp.uint32(0))
        return jnp.stack([_word_of(row, at[0] - 32 * word) for word in range(columns // 32)])

    drawn = jax.vmap(draw_one)(stencils, at)
    return lax.reduce(drawn, jnp.uint32(0), lax.bitwise_or, dimensions=(0,))


def _word_of(row: Array, at: Array) -> Array:
    by = jnp.minimum(jnp.abs(at), 31).astype(jnp.uint32)
    return jnp.where(jnp.abs(at) < 32, jnp.where(at >= 0, row << by, row >> by), jnp.uint32(0))


def reach_set(
    grid: Grid,
    field: Array,
    allowed: Array,
    movers: Obstacles,
    vehicle: Vehicle,
    initial_speed: Array,
    needed: Array,
    goal: Array | None = None,
) -> ReachSet:
    """Compute which states a vehicle can reach at each time layer.

    With `goal` it is the set of the states from which the vehicle can reach a goal at the horizon:
    time runs backwards, so that layer 0 of the result is at the horizon. The speeds of `vehicle`
    are then the negative speeds of its levels.

    Args:
        grid: positions of the cells and times of the layers, from `grid_of`.
        field: (cells along y, cells along x) [m], distances of the cells' middles from walls.
        allowed: (headings, cells along y, cells along x) bool, whether the rear axle may be there,
            because the body's middle is then on the map.
        movers: moving obstacles.
        vehicle: sizes and limits of the vehicle.
        initial_speed: () [m/s].
        needed: () int32, number of layers to compute, equal for all cases of a batch.
        goal: (levels, headings, cells along y, cells along x) bool, states at the goal.
    """
    lattice, speeds = grid.lattice, vehicle.speeds
    levels, headings, (columns, rows) = lattice.num_speeds, lattice.headings, lattice.cells
    dtype = grid.corner.dtype
    width = 2.0 * np.pi / headings
    angle = grid.heading + width * jnp.arange(headings, dtype=dtype)
    direction = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    pace = (speeds * grid.step)[None, :, None, None] / grid.cell[None, None, None]
    # A move is the difference of two rounded positions, so that the moves of n layers add up to the
    # rounded position. If each move were rounded, a car with a heading of 11 degrees would never
    # change its row of cells.
    half_steps = jnp.arange(2 * lattice.layers + 2, dtype=dtype)[:, None, None, None]
    cells = jnp.round(0.5 * half_steps * pace * direction[None, None])
    halves = jnp.diff(cells.astype(jnp.int32), axis=0)  # (2 layers + 1, levels, headings, 2)
    halves = jnp.clip(halves, -_FARTHEST, _FARTHEST)
    moves = jnp.moveaxis(halves[1:].reshape(-1, 2, levels, headings, 2), 1, 3)
    most = vehicle.turn_rates * grid.step / width
    before = jnp.arange(lattice.layers + 1, dtype=dtype)[:, None]
    whole = jnp.diff(jnp.floor(before * most[None] + 0.1), axis=0)  # (layers, levels)
    turns = jnp.abs(jnp.arange(-SPAN, SPAN + 1, dtype=dtype))[None, None] <= whole[..., None]
    gap = jnp.max(jnp.abs(jnp.diff(speeds)))
    change = vehicle.acceleration * grid.step / jnp.maximum(gap, 1e-6)
    layer_ends = jnp.arange(lattice.layers + 1, dtype=dtype)
    changes = jnp.diff(jnp.floor(layer_ends * jnp.minimum(change, 1.0) + 0.1)) >= 1.0
    walls = _pack(field < vehicle.radius)
    # Movers without a track do not turn, so that one bitmap serves all times. Their growth is
    # taken from the middle of the time.
    still = _stencils(grid, movers, vehicle.radius, 0.5 * grid.step * grid.num.astype(dtype))
    back = -vehicle.ahead[:, None, None] * direction[None]
    discs = jnp.round(back / grid.cell[None, None]).astype(jnp.int32)
    packed = _pack(allowed)

    times = 0.5 * grid.step * jnp.arange(2 * lattice.layers + 2, dtype=dtype)
    if goal is not None:  # entry 1 is at the horizon
        times = 0.5 * grid.step * (2 * grid.num + 1).astype(dtype) - (times - times[1])
    halves_needed = 2 * needed + 2

    def draw_obstacles(time: Array) -> Array:
        turned = movers.track is not None
        stencils = _stencils(grid, movers, vehicle.radius, time) if turned else still
        return walls | _draw_movers(grid, movers, stencils, time)

    blocked = _map_needed(draw_obstacles, times, halves_needed)

    def find_free(blocked: Array) -> Array:
        each = jnp.broadcast_to(blocked[:, None], (columns // 32, headings, rows))
        touched = functools.reduce(jnp.bitwise_or, (_shift(each, disc) for disc in discs))
        return packed & ~touched

    free = _map_needed(find_free, blocked, halves_needed)  # for every half step between layers

    # Without reverse, level 0 is standstill and does not move.
    lowest = 0 if lattice.reverse_levels else 1

    def move_y(bits: Array, n: Array, half: int) -> Array:
        moved = _move_y(bits[:, lowest:], moves[n, lowest:, :, half, 1])
        return jnp.concatenate([bits[:, :lowest], moved], axis=1)

    def move_x(bits: Array, n: Array, half: int) -> Array:
        moved = _move_x(bits[:, lowest:], moves[n, lowest:, :, half, 0])
        moved = jnp.concatenate([bits[:, :lowest], moved], axis=1)
        return moved & free[2 * n + half + 2][:, None]

    parts = [
        lambda bits, n: jnp.where(changes[n], _change_speed(bits), bits),
        lambda bits, n: _turn(bits, turns[n]),
        *(functools.partial(move, half=half) for half in range(2) for move in (move_y, move_x)),
    ]

    # Each part (a change of speed, a turn, a move) is an iteration of its own. XLA would otherwise
    # fuse them on a CPU, and repeat the work of one part for every bit that the next part reads.
    def apart(bits: Array, n: Array) -> Array:
        return lax.fori_loop(0, len(parts), lambda k, bits: lax.switch(k, parts, bits, n), bits)

    def at_once(bits: Array, n: Array) -> Array:
        for part in parts:
            bits = part(bits, n)
        return bits

    def layer(n: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        bits, layers = state
        bits = lax.platform_dependent(bits, n, cpu=apart, default=at_once)
        return bits, lax.dynamic_update_index_in_dim(layers, bits, n + 1, 0)

    if goal is None:
        first = _start_bits(grid, initial_speed, speeds)
        first = _shift(first & free[0][:, None], halves[0]) & free[1][:, None]
    else:
        first = _pack(goal) & free[1][:, None]
    layers = jnp.zeros((lattice.layers + 1, *first.shape), first.dtype).at[0].set(first)
    _, layers = lax.fori_loop(0, needed, layer, (first, layers))
    return ReachSet(bits=layers, moves=moves, turns=turns, changes=changes, speeds=speeds)


def _start_bits(grid: Grid, initial_speed: Array, speeds: Array) -> Array:
    lattice, cell = grid.lattice, grid.start
    # The levels below and above the initial speed.
    gap = jnp.where(initial_speed < 0.0, speeds[1] - speeds[0], speeds[-1] - speeds[-2])
    near = jnp.abs(jnp.clip(initial_speed, speeds[0], speeds[-1]) - speeds) < 0.999 * gap
    x, y = (jnp.arange(num, dtype=cell.dtype) for num in lattice.cells)
    at = (y[:, None] == cell[1]) & (x[None] == cell[0])
    bits = near[:, None, None] & (jnp.arange(lattice.headings) == 0)[None, :, None]
    return jnp.where(bits, _pack(at)[:, None, None], jnp.uint32(0))


def _change_speed(bits: Array) -> Array:
    none = jnp.zeros_like(bits[:, :1])
    slower = jnp.concatenate([bits[:, 1:], none], axis=1)
    return bits | slower | jnp.concatenate([none, bits[:, :-1]], axis=1)


def _turn(bits: Array, turns: Array) -> Array:
    reached = jnp.zeros_like(bits)
    for k in range(2 * SPAN + 1):
        by = jnp.roll(bits, k - SPAN, axis=2)
        reached |= jnp.where(turns[:, k, None, None], by, jnp.uint32(0))
    return reached


def widen(bits: Array) -> Array:
    """Add all neighbours in speed level, heading and cell to a bitmap of states."""
    bits = _change_speed(bits)
    bits |= jnp.roll(bits, 1, axis=2) | jnp.roll(bits, -1, axis=2)
    one = jnp.ones(bits.shape[1:3], jnp.int32)
    for move in (_move_x, _move_y):
        bits |= move(bits, one) | move(bits, -one)
    return bits


def bit_at(bits: Array, level: Array, heading: Array, cell: Array) -> Array:
    """Test whether a state (speed level, heading bin, cell [x, y]) is marked in a bitmap.

    `bits` is (words, levels, headings, cells along y) uint32. Bit i of word w is the cell 32 w + i
    along x.
    """
    words, levels, headings, rows = bits.shape
    x, y = jnp.clip(cell[0], 0, 32 * words - 1), jnp.clip(cell[1], 0, rows - 1)
    inside = (x == cell[0]) & (y == cell[1]) & (level >= 0) & (level < levels)
    word = bits[x // 32, jnp.clip(level, 0, levels - 1), heading % headings, y]
    return inside & (((word >> (x % 32).astype(jnp.uint32)) & 1) > 0)


def goal_cells(
    grid: Grid, layer: Array, goals: Array, ahead: Array, headings: Array
) -> tuple[Array, Array]:
    """Return the cells at the positions of goals, and whether the car can be there.

    Args:
        grid: grid of the reach set.
        layer: (words, levels, headings, cells) uint32, bits of the time layer of the meeting.
        goals: (9, 2) [m], positions to be met; if all are equal, one position.
        ahead: () [m], distance from the rear axle forward to the point that meets the goal.
        headings: (headings,) bool, allowed headings.

    Returns:
        cells: (headings, 9, 2) int32, indices [x, y] of cells for the rear axle: each is nearest to
            a goal, and displaced by one of 3 x 3 steps. The first of the 9 cells is not displaced.
        is_reached: (levels, headings, 9) bool, whether the car can be in the cell.
    """
    lattice = grid.lattice
    width = 2.0 * np.pi / lattice.headings
    bins = jnp.arange(lattice.headings)
    angle = grid.heading + width * bins.astype(grid.cell.dtype)
    back = ahead * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    axle = goals[None] - back[:, None]
    corner, cell = grid.corner[None, None], grid.cell[None, None]
    nearest = jnp.round((axle - corner) / cell).astype(jnp.int32)
    cells = nearest + jnp.asarray(AROUND, jnp.int32)[None]
    of_level = jax.vmap(jax.vmap(bit_at, (None, None, None, 0)), (None, None, 0, 0))
    of_all = jax.vmap(of_level, (None, 0, None, None))
    return cells, of_all(layer, jnp.arange(lattice.num_speeds), bins, cells) & headings[
        None, :, None
    ]
