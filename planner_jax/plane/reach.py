"""Where a car can be, and when: a reach set in space and time, one bit a cell.

A layer of the set holds, for every level of speed, every heading and every cell of a square grid,
one bit: whether the car can be there at that layer's time, among obstacles that stand and move. At
a layer the speed changes by a level at most, and the heading by some bins; up to the next one the
car moves on straight, as it does for half as long before the first layer. Way and time are
searched together, so that a car can wait for an obstacle to pass, or be there before it; one set
answers all ways round the obstacles, all headings and all meeting times. Ways are then drawn
backwards from the goal at random, each a homotopy of its own.

The cells of a row are the bits of two words, so that a move is a choice of rows and a shift. What
is found is coarse: it is where an optimiser begins.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.plane.obstacles import Obstacles, distances

CELLS = 64  # along either side of the grid
_WORDS = 2  # a row's bits
_STENCIL = 32  # cells along either side of what is drawn of one moving obstacle
_SPAN = 2  # bins of heading to either side that a layer may turn, at most


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Lattice:
    """Sizes of a reach set."""

    layers: int = 30  # in time, at most
    levels: int = 4  # of speed, with standing
    headings: int = 32
    pace: float = 6.0  # cells that the car moves in a layer at its greatest speed


@struct.dataclass
class Grid:
    """Where the cells and layers of one case lie."""

    corner: Array  # (2,) [m], middle of the cell (0, 0)
    cell: Array  # () [m]
    step: Array  # () [s], from layer to layer; layer n is at (n + 1/2) steps
    num: Array  # () int32, the layer at the horizon
    heading: Array  # () [rad], of bin 0


@struct.dataclass
class ReachSet:
    """Bits of all layers, and how they came about."""

    bits: Array  # (layers + 1, 2, levels, headings, CELLS) uint32; rows are y, bits are x
    moves: Array  # (layers, levels, headings, 2, 2) int32, cells [x, y] in either half of a step
    turns: Array  # (levels, 2 _SPAN + 1) bool, which turns a level of speed allows


@struct.dataclass
class Way:
    """Speed and heading after every layer of a way through a reach set."""

    level: Array  # (layers,) int32, of speed from one layer to the next
    bin: Array  # (layers,) int32, of heading, not wrapped


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
    cell = jnp.max(upper - lower) / CELLS
    paces = jnp.floor(time * speed / (lattice.pace * cell) - 0.5 + 1e-3)
    num = jnp.clip(paces, 1, lattice.layers)
    step = time / (num + 0.5)
    offset = jnp.round((start[:2] - lower) / cell - 0.5)
    return Grid(
        corner=start[:2] - cell * offset,
        cell=cell,
        step=step,
        num=num.astype(jnp.int32),
        heading=start[2],
    )


def distance_field(grid: Grid, walls: Obstacles, lower: Array, upper: Array) -> Array:
    """How far every cell's middle is from the nearest wall, (CELLS, CELLS) [m], rows are y.

    Negative inside of a wall. The edge of the map is none.
    """
    place = grid.cell * jnp.arange(CELLS, dtype=grid.corner.dtype)
    x, y = jnp.meshgrid(grid.corner[0] + place, grid.corner[1] + place)
    vertices = walls.vertices(jnp.zeros_like(grid.cell))
    far, _ = distances(vertices, walls.present, x.reshape(1, -1), y.reshape(1, -1))
    return jnp.min(far, axis=0).reshape(CELLS, CELLS)


def _packed(cells: Array) -> Array:
    """Bits of cells (..., W * 32) bool as words (W, ...)."""
    bits = cells.reshape(*cells.shape[:-1], -1, 32).astype(jnp.uint32)
    words = jnp.sum(bits << jnp.arange(32, dtype=jnp.uint32), axis=-1, dtype=jnp.uint32)
    return jnp.moveaxis(words, -1, 0)


def _shifted(rows: Array, move: Array) -> Array:
    """Cells moved by [x, y]; what leaves the grid is lost.

    Args:
        rows: (2, ..., CELLS) uint32.
        move: (..., 2) int32, |x| < 32.
    """
    y = jnp.arange(CELLS) - move[..., 1:]
    lane = CELLS * np.arange(y.size // CELLS, dtype=np.int32).reshape(*y.shape[:-1], 1)
    place = jnp.clip(y, 0, CELLS - 1) + lane
    none = jnp.uint32(0)
    inside = (y >= 0) & (y < CELLS)
    low, high = (
        jnp.where(inside, word.reshape(-1).at[place].get(mode="promise_in_bounds"), none)
        for word in rows
    )
    by = jnp.abs(move[..., :1]).astype(jnp.uint32)
    carry = (32 - by) & 31
    some = by > 0
    up = (low << by, (high << by) | jnp.where(some, low >> carry, none))
    down = ((low >> by) | jnp.where(some, high << carry, none), high >> by)
    right = move[..., :1] >= 0
    return jnp.stack([jnp.where(right, a, b) for a, b in zip(up, down, strict=True)])


def _stencils(grid: Grid, movers: Obstacles, radius: Array) -> Array:
    """Rows of bits around the middle of every moving obstacle, (M, _STENCIL) uint32."""
    place = grid.cell * (jnp.arange(_STENCIL, dtype=grid.corner.dtype) - _STENCIL // 2)
    x, y = jnp.meshgrid(place, place)
    far, _ = distances(movers.corners, movers.present, x.reshape(1, -1), y.reshape(1, -1))
    return _packed((far < radius).reshape(-1, _STENCIL, _STENCIL))[0]


def _blocked_by(grid: Grid, movers: Obstacles, stencils: Array, time: Array) -> Array:
    """Cells that moving obstacles take at one time, (2, CELLS) uint32."""
    middle = (movers.centre + movers.velocity * time - grid.corner) / grid.cell
    at = jnp.round(jnp.clip(middle, -64.0, 128.0)).astype(jnp.int32) - _STENCIL // 2

    def of_one(stencil: Array, at: Array) -> Array:
        y = jnp.arange(CELLS) - at[1]
        row = jnp.where(
            (y >= 0) & (y < _STENCIL), stencil[jnp.clip(y, 0, _STENCIL - 1)], jnp.uint32(0)
        )
        words = [_word_of(row, at[0] - 32 * word) for word in range(_WORDS)]
        return jnp.stack(words)

    return lax.reduce(
        jax.vmap(of_one)(stencils, at), jnp.uint32(0), lax.bitwise_or, dimensions=(0,)
    )


def _word_of(row: Array, at: Array) -> Array:
    """A row of 32 bits that begins at a place, as one word sees it."""
    by = jnp.minimum(jnp.abs(at), 31).astype(jnp.uint32)
    moved = jnp.where(at >= 0, row << by, row >> by)
    return jnp.where(jnp.abs(at) < 32, moved, jnp.uint32(0))


@struct.dataclass
class Footprint:
    """The body as two discs, for the grid."""

    radius: Array  # () [m]
    ahead: Array  # (2,) [m], their middles from the rear axle


def reach_set(
    lattice: Lattice,
    grid: Grid,
    field: Array,
    movers: Obstacles,
    footprint: Footprint,
    speed: Array,
    initial_speed: Array,
    start: Array,
    turn_rates: Array,
    lower: Array,
    upper: Array,
    needed: Array,
) -> ReachSet:
    """All that the car can reach.

    Args:
        lattice: sizes.
        grid: of `grid_of`.
        field: of `distance_field`.
        movers: obstacles that move.
        footprint: of the car.
        speed: () [m/s], the greatest.
        initial_speed: () [m/s].
        start: (3,) pose of the rear axle.
        turn_rates: (levels,) [rad/s], the greatest at each level of speed.
        lower: (2,) [m], corner of the map, which the footprint's middle does not leave.
        upper: (2,) [m], opposite corner.
        needed: () int32, layers to work out; of a batch the same for all, the most.
    """
    levels, headings = lattice.levels, lattice.headings
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
    moves = jnp.moveaxis(halves[1:].reshape(-1, 2, levels, headings, 2), 1, 3)
    most = turn_rates * grid.step / width
    span = jnp.abs(jnp.arange(-_SPAN, _SPAN + 1))
    turns = span <= most[:, None] + 0.1
    walls = _packed(field < footprint.radius)
    stencils = _stencils(grid, movers, footprint.radius)
    discs = jnp.round(-footprint.ahead[:, None, None] * direction / grid.cell).astype(jnp.int32)
    middle = jnp.mean(footprint.ahead) * direction  # of the body from the rear axle
    place = grid.corner[:, None] + grid.cell * jnp.arange(CELLS, dtype=dtype)
    on_map = (place + middle[:, :, None] > lower[:, None]) & (
        place + middle[:, :, None] < upper[:, None]
    )
    columns = _packed(on_map[:, 0])[..., None]
    allowed = jnp.where(on_map[:, 1], columns, jnp.uint32(0))

    def free_at(time: Array) -> Array:
        """Where the rear axle can be with every heading, (2, headings, CELLS)."""
        blocked = walls | _blocked_by(grid, movers, stencils, time)
        each = jnp.broadcast_to(blocked[:, None], (_WORDS, headings, CELLS))
        return allowed & ~(_shifted(each, discs[0]) | _shifted(each, discs[1]))

    def change(bits: Array, n: Array) -> Array:
        return _turned(_faster_or_slower(bits), turns)

    def move(bits: Array, n: Array, half: int) -> Array:
        free = free_at((n + 0.5 * (half + 2)) * grid.step)[:, None]
        return free & jnp.concatenate(
            [bits[:, :1], _shifted(bits[:, 1:], moves[n, 1:, :, half])], axis=1
        )

    # Each third of a layer is a step of the loop of its own: a compiler that joins them works
    # out the first anew for every bit that the next one looks up.
    thirds = [change, functools.partial(move, half=0), functools.partial(move, half=1)]

    def third(k: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        bits, layers = state
        n = k // 3
        bits = lax.switch(k % 3, thirds, bits, n)
        return bits, lax.dynamic_update_index_in_dim(layers, bits, n + 1, 0)

    first = _start_bits(lattice, grid, start, initial_speed, speed)
    first = _shifted(first & free_at(jnp.zeros((), dtype))[:, None], halves[0])
    first &= free_at(0.5 * grid.step)[:, None]
    layers = jnp.zeros((lattice.layers + 1, *first.shape), first.dtype).at[0].set(first)
    _, layers = lax.fori_loop(0, 3 * needed, third, (first, layers))
    return ReachSet(bits=layers, moves=moves, turns=turns)


def _start_bits(
    lattice: Lattice, grid: Grid, start: Array, initial_speed: Array, speed: Array
) -> Array:
    """The first layer: the levels of speed about that of the car."""
    cell = jnp.round((start[:2] - grid.corner) / grid.cell).astype(jnp.int32)
    level = initial_speed / speed * (lattice.levels - 1)
    near = jnp.abs(jnp.arange(lattice.levels) - level) < 1.0
    at = (jnp.arange(CELLS)[:, None] == cell[1]) & (jnp.arange(CELLS) == cell[0])
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
    """Whether a layer (2, levels, headings, CELLS) holds a cell (2,) [x, y]; bool."""
    _, levels, headings, _ = bits.shape
    inside = jnp.all((cell >= 0) & (cell < CELLS)) & (level >= 0) & (level < levels)
    x, y = jnp.clip(cell, 0, CELLS - 1)
    word = bits[x // 32, jnp.clip(level, 0, levels - 1), heading % headings, y]
    return inside & (((word >> (x % 32).astype(jnp.uint32)) & 1) > 0)


def goal_cells(
    lattice: Lattice, grid: Grid, layer: Array, goal: Array, ahead: Array, headings: Array
) -> tuple[Array, Array]:
    """What of a layer lies at a goal.

    Args:
        lattice: sizes.
        grid: of the reach set.
        layer: (2, levels, headings, CELLS) uint32.
        goal: (2,) [m].
        ahead: () [m], from the rear axle to what meets the goal.
        headings: (headings,) bool, which may.

    Returns:
        cells: (headings, 9, 2) int32, those about the goal.
        is_there: (levels, headings, 9) bool.
    """
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
    """Gumbel noise that one random way takes, or that of some with a leading axis."""

    ends: Array  # (levels, headings, 9), on where it ends
    steps: Array  # (layers, 3 (2 _SPAN + 1)), on where it comes from


def draw_chance(lattice: Lattice, num: int, seed: int) -> Chance:
    """Noise for some ways, the same for all cases, so that none draws it anew."""
    rng = np.random.default_rng(seed)
    ends = rng.gumbel(size=(num, lattice.levels, lattice.headings, 9))
    steps = rng.gumbel(size=(num, lattice.layers, 3 * (2 * _SPAN + 1)))
    return Chance(ends=jnp.asarray(ends, jnp.float32), steps=jnp.asarray(steps, jnp.float32))


def draw_way(
    lattice: Lattice,
    reach: ReachSet,
    num: Array,
    cells: Array,
    there: Array,
    chance: Chance,
) -> Way:
    """A random way to a goal, walked back from it.

    Args:
        lattice: sizes.
        reach: the set.
        num: () int32, the layer that meets the goal.
        cells: of `goal_cells`.
        there: of `goal_cells`; without any the way means nothing.
        chance: what makes it this way and no other.
    """
    noise = chance.ends + jnp.where(jnp.arange(9) == 0, 1.0, 0.0)  # rather at the goal itself
    best = jnp.argmax(jnp.where(there, noise, -jnp.inf))
    level, heading, around = jnp.unravel_index(best, there.shape)
    choices = jnp.asarray(
        np.stack(
            np.meshgrid([-1, 0, 1], np.arange(-_SPAN, _SPAN + 1), indexing="ij"), axis=-1
        ).reshape(-1, 2)
    )

    def back(state: tuple, n: Array) -> tuple[tuple, tuple]:
        level, heading, cell, last = state
        before = cell - jnp.sum(reach.moves[n, level, heading % lattice.headings], axis=0)
        from_level, turn = level + choices[:, 0], choices[:, 1]
        bits = reach.bits[n]
        is_way = jax.vmap(lambda v, h: bit_at(bits, v, h, before))(from_level, heading - turn)
        is_way &= reach.turns[level, turn + _SPAN]
        rough = jnp.abs(turn) + jnp.abs(turn - last) + jnp.abs(choices[:, 0])
        chosen = jnp.argmax(jnp.where(is_way, chance.steps[n] - 0.5 * rough, -jnp.inf))
        after = (from_level[chosen], heading - turn[chosen], before, turn[chosen])
        new = jax.tree.map(lambda a, b: jnp.where(n < num, a, b), after, state)
        return new, (level, heading)

    start = (
        level.astype(jnp.int32),
        heading.astype(jnp.int32),
        cells[heading, around],
        jnp.int32(0),
    )
    _, (levels, bins) = lax.scan(back, start, jnp.arange(lattice.layers), reverse=True)
    # Bins of heading count from the start on, without a jump.
    return Way(level=levels, bin=bins)
