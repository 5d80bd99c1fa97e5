"""Where a car can be, and when: a reach set in space and time, one bit a cell.

A layer of the set holds, for every level of speed, every heading and every cell of a square grid,
one bit: whether the car can be there at that layer's time, among obstacles that stand and move. At
a layer the speed changes by a level at most, and the heading by some bins; up to the next one the
car moves on straight, as it does for half as long before the first layer. Way and time are
searched together, so that a car can wait for an obstacle to pass, or be there before it; one set
answers all ways round the obstacles, all headings and all meeting times. Ways are then drawn
backwards from the goal at random, each a homotopy of its own.

The cells of a row are the bits of words, so that a move is a choice of rows and a shift. What
is found is coarse: it is where an optimiser begins.
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
# What counts against a step of a way, beside noise.
_TURNING = 0.5  # a turn by a bin, and a change of the turn
_UNEVEN = 1.0  # a change of speed by a level
_SPAN = 3  # bins of heading to either side that a layer may turn, at most


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
    """Where the cells and layers of one case lie."""

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
    """What moves over the grid: a reference point with two discs that cover the body."""

    radius: Array  # () [m], of the discs
    ahead: Array  # (2,) [m], of their middles from the reference point
    speed: Array  # () [m/s], the greatest
    turn_rates: Array  # (levels,) [rad/s], the greatest at each level of speed


@struct.dataclass
class ReachSet:
    """Bits of all layers, and how they came about."""

    bits: Array  # (layers + 1, words, levels, headings, cells) uint32; rows are y, bits x
    moves: Array  # (layers, levels, headings, 2, 2) int32, cells [x, y] in either half of a step
    turns: Array  # (layers, levels, 2 _SPAN + 1) bool, which turns a level of speed allows


@struct.dataclass
class CellPath:
    """Speed, heading and cell after every layer of a way through a reach set."""

    level: Array  # (layers,) int32, of speed from one layer to the next
    bin: Array  # (layers,) int32, of heading, not wrapped
    cell: Array  # (layers, 2) int32


def grid_of(
    lattice: Lattice, start: Array, time: Array, speed: Array, lower: Array, upper: Array
) -> Grid:
    """The grid of a map for a horizon.

    Args:
        lattice: sizes.
        start: (3,) x, y [m] and heading [rad], which lie on the grid.
        time: () [s], the horizon, which the last layer meets.
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
    """Bits of cells (..., W * 32) bool as words (W, ...)."""
    bits = cells.reshape(*cells.shape[:-1], -1, 32).astype(jnp.uint32)
    words = jnp.sum(bits << jnp.arange(32, dtype=jnp.uint32), axis=-1, dtype=jnp.uint32)
    return jnp.moveaxis(words, -1, 0)


def _along_y(rows: Array, move: Array) -> Array:
    """Rows moved by so many cells, at most `_FARTHEST`; what leaves the grid is lost.

    Args:
        rows: (words, ..., cells) uint32.
        move: (...) int32.
    """
    words, cells = rows.shape[0], rows.shape[-1]
    padded = jnp.pad(rows.reshape(words, -1, cells), ((0, 0), (0, 0), (_FARTHEST, _FARTHEST)))
    moved = jax.vmap(
        lambda row, by: lax.dynamic_slice_in_dim(row, _FARTHEST - by, cells, axis=1),
        in_axes=(1, 0),
        out_axes=1,
    )(padded, move.reshape(-1))
    return moved.reshape(rows.shape)


def _along_x(rows: Array, move: Array) -> Array:
    """Bits (words, ..., cells) moved by (...) cells, under 32; what leaves the grid is lost."""
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
    """Cells (words, ..., cells) moved by (..., 2) [x, y]; what leaves the grid is lost."""
    return _along_x(_along_y(rows, move[..., 1]), move[..., 0])


def _of_each(body: Callable[[Array], Array], over: Array, needed: Array) -> Array:
    """What a function makes of the first entries, as many as needed.

    On a CPU in a loop, so that each is there in full before it is used.
    """

    def looped(over: Array, needed: Array) -> Array:
        one = jax.eval_shape(body, over[0])
        made = jnp.zeros((over.shape[0], *one.shape), one.dtype)
        return lax.fori_loop(0, needed, lambda k, made: made.at[k].set(body(over[k])), made)

    return lax.platform_dependent(
        over, needed, cpu=looped, default=lambda over, _: jax.vmap(body)(over)
    )


def _stencils(grid: Grid, movers: Obstacles, radius: Array) -> Array:
    """Rows of bits around the middle of every moving obstacle, (M, _STENCIL) uint32."""
    place = grid.cell * (jnp.arange(_STENCIL, dtype=grid.corner.dtype) - _STENCIL // 2)
    x, y = jnp.meshgrid(place, place)
    far, _ = distances(movers.corners, movers.present, x.reshape(1, -1), y.reshape(1, -1))
    return _packed((far < radius).reshape(-1, _STENCIL, _STENCIL))[0]


def _blocked_by(grid: Grid, movers: Obstacles, stencils: Array, time: Array) -> Array:
    """Cells that moving obstacles take at one time, (words, cells) uint32."""
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
    """A row of 32 bits that begins at a place, as one word sees it."""
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
    """All that a vehicle can reach.

    Args:
        grid: of `grid_of`.
        field: (cells, cells) [m], how far every cell's middle is from what stands; rows are y.
        movers: obstacles that move.
        vehicle: what moves among them.
        initial_speed: () [m/s].
        needed: () int32, layers to work out; of a batch the same for all, the most.
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
    span = jnp.abs(jnp.arange(-_SPAN, _SPAN + 1))
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
        """Cells that something takes, (words, cells)."""
        return walls | _blocked_by(grid, movers, stencils, time)

    blocked = _of_each(blocked_at, times, halves_needed)

    def free_of(blocked: Array) -> Array:
        """Where the rear axle can be with every heading, (words, headings, cells)."""
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
        """One layer, each part a step of a loop of its own.

        A compiler for CPUs that joins them works out the first anew for every bit that the next
        one looks up.
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
    """The first layer: the levels of speed about that of the vehicle."""
    lattice, cell = grid.lattice, grid.start
    level = initial_speed / speed * (lattice.levels - 1)
    near = jnp.abs(jnp.arange(lattice.levels) - level) < 1.0
    place = jnp.arange(lattice.cells)
    at = (place[:, None] == cell[1]) & (place == cell[0])
    here = near[:, None, None] & (jnp.arange(lattice.headings) == 0)[:, None]
    return jnp.where(here, _packed(at)[:, None, None], jnp.uint32(0))


def _faster_or_slower(bits: Array) -> Array:
    """Every level of speed with what its neighbours hold."""
    none = jnp.zeros_like(bits[:, :1])
    slower = jnp.concatenate([bits[:, 1:], none], axis=1)
    return bits | slower | jnp.concatenate([none, bits[:, :-1]], axis=1)


def _turned(bits: Array, turns: Array) -> Array:
    """Every heading with what those hold from which it can be turned to."""
    found = jnp.zeros_like(bits)
    for k in range(2 * _SPAN + 1):
        by = jnp.roll(bits, k - _SPAN, axis=2)
        found |= jnp.where(turns[:, k, None, None], by, jnp.uint32(0))
    return found


def bit_at(bits: Array, level: Array, heading: Array, cell: Array) -> Array:
    """Whether a layer (words, levels, headings, cells) holds a cell (2,) [x, y]; bool."""
    _, levels, headings, cells = bits.shape
    inside = jnp.all((cell >= 0) & (cell < cells)) & (level >= 0) & (level < levels)
    x, y = jnp.clip(cell, 0, cells - 1)
    word = bits[x // 32, jnp.clip(level, 0, levels - 1), heading % headings, y]
    return inside & (((word >> (x % 32).astype(jnp.uint32)) & 1) > 0)


def goal_cells(
    grid: Grid, layer: Array, goal: Array, ahead: Array, headings: Array
) -> tuple[Array, Array]:
    """What of a layer lies at a goal.

    Args:
        grid: of the reach set.
        layer: (words, levels, headings, cells) uint32.
        goal: (2,) [m].
        ahead: () [m], from the rear axle to what meets the goal.
        headings: (headings,) bool, which may.

    Returns:
        cells: (headings, 9, 2) int32, those about the goal.
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


@struct.dataclass
class Chance:
    """Gumbel noise that one way takes, the smoothest of D, or many ways with a leading axis."""

    layers: Array  # (layers + 1,), on when it ends
    ends: Array  # (D, levels, headings, 9), on where it ends
    steps: Array  # (D, layers, 3 (2 _SPAN + 1)), on where it comes from


def draw_chance(lattice: Lattice, num: int, seed: int, drawn: int) -> Chance:
    """Noise for some ways, the same for all cases, so that none draws it anew."""
    rng = np.random.default_rng(seed)
    ends = rng.gumbel(size=(num, drawn, lattice.levels, lattice.headings, 9))
    steps = rng.gumbel(size=(num, drawn, lattice.layers, 3 * (2 * _SPAN + 1)))
    layers = rng.gumbel(size=(num, lattice.layers + 1))
    return Chance(*(jnp.asarray(each, jnp.float32) for each in (layers, ends, steps)))


def draw_smooth_path(
    grid: Grid,
    reach: ReachSet,
    num: Array,
    cells: Array,
    there: Array,
    chance: Chance,
    directness: float,
) -> CellPath:
    """The smoothest of some random ways to a goal; arguments as of `draw_path`."""
    ways = jax.vmap(
        lambda ends, steps: draw_path(grid, reach, num, cells, there, ends, steps, directness)
    )(chance.ends, chance.steps)
    best = jnp.argmin(jax.vmap(lambda way: _roughness(way, grid.lattice, num))(ways))
    return jax.tree.map(lambda leaf: leaf[best], ways)


def _velocity(level: Array, heading: Array, lattice: Lattice) -> Array:
    """Velocities (..., 2) of levels and bins (...), in levels, along the heading of bin 0."""
    angle = (2.0 * np.pi / lattice.headings) * heading
    return level[..., None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def _roughness(path: CellPath, lattice: Lattice, num: Array) -> Array:
    """Sum of the squared changes of velocity over two layers, in levels of speed."""
    velocity = _velocity(path.level, path.bin, lattice)
    change = jnp.sum((velocity[2:] - velocity[:-2]) ** 2, axis=1)
    return jnp.sum(jnp.where(jnp.arange(2, lattice.layers) < num, change, 0.0))


def draw_path(
    grid: Grid,
    reach: ReachSet,
    num: Array,
    cells: Array,
    there: Array,
    ends: Array,
    steps: Array,
    directness: float,
) -> CellPath:
    """A random way to a goal, walked back from it.

    Args:
        grid: of the reach set.
        reach: the set.
        num: () int32, the layer that meets the goal.
        cells: of `goal_cells`.
        there: of `goal_cells`; without any the way means nothing.
        ends: (levels, headings, 9), noise on where it ends.
        steps: (layers, 3 (2 _SPAN + 1)), noise on where it comes from.
        directness: what counts against a velocity beside the mean of the way up to there, squared,
            in levels of speed; more makes ways straight and even, none makes them differ more.
    """
    lattice = grid.lattice
    noise = ends + jnp.where(jnp.arange(9) == 0, 1.0, 0.0)  # rather at the goal itself
    best = jnp.argmax(jnp.where(there, noise, -jnp.inf))
    level, heading, around = jnp.unravel_index(best, there.shape)
    choices = jnp.asarray(
        np.stack(
            np.meshgrid([-1, 0, 1], np.arange(-_SPAN, _SPAN + 1), indexing="ij"), axis=-1
        ).reshape(-1, 2),
        jnp.int32,
    )

    # Velocities are in levels of speed, along the heading of bin 0 and across.
    cosine, sine = jnp.cos(grid.heading), jnp.sin(grid.heading)
    along = jnp.stack([jnp.stack([cosine, sine]), jnp.stack([-sine, cosine])])
    along *= (lattice.levels - 1) / lattice.pace

    def back(state: tuple, n: Array) -> tuple[tuple, tuple]:
        level, heading, cell, last = state
        before = cell - jnp.sum(reach.moves[n, level, heading % lattice.headings], axis=0)
        from_level, turn = level + choices[:, 0], choices[:, 1]
        bits = reach.bits[n]
        is_way = jax.vmap(lambda v, h: bit_at(bits, v, h, before))(from_level, heading - turn)
        is_way &= reach.turns[n, level, turn + _SPAN]
        rough = _TURNING * (jnp.abs(turn) + jnp.abs(turn - last))
        rough += _UNEVEN * jnp.abs(choices[:, 0])
        mean = jnp.dot(along, (before - grid.start) / (n + 0.5), precision=lax.Precision.HIGHEST)
        velocity = _velocity(from_level, heading - turn, lattice)
        rough += directness * jnp.sum((velocity - mean) ** 2, axis=-1)
        chosen = jnp.argmax(jnp.where(is_way, steps[n] - rough, -jnp.inf))
        after = (from_level[chosen], heading - turn[chosen], before, turn[chosen])
        new = jax.tree.map(lambda a, b: jnp.where(n < num, a, b), after, state)
        return new, (level, heading, cell)

    start = (
        level.astype(jnp.int32),
        heading.astype(jnp.int32),
        cells[heading, around],
        jnp.int32(0),
    )
    _, (levels, bins, passed) = lax.scan(back, start, jnp.arange(lattice.layers), reverse=True)
    # Bins of heading count from the start on, without a jump.
    return CellPath(level=levels, bin=bins, cell=passed)
