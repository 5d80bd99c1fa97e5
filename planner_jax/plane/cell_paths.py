"""Random paths of a car through a reach set, drawn backwards from the goal.

A reach set (`plane.reach`) marks which cells of a grid the car can reach at each time layer. The
planner of interceptions starts its optimisation from these paths.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.arithmetic import host_leaf
from planner_jax.plane.reach import SPAN, Grid, Lattice, ReachSet, bit_at

# Costs of one step of a path. The step with the least cost minus Gumbel noise is drawn.
_TURNING = 0.5  # cost of a turn by one heading bin, and of a change of the turn by one bin
_UNEVEN = 1.0  # cost of a change of speed by one level


@struct.dataclass
class CellPath:
    """A car's path on a grid: speed level, heading bin and cell at equal time steps (layers)."""

    level: Array  # (layers,) int32, index of the speed up to the next layer
    bin: Array  # (layers,) int32, index of the heading, not wrapped to one revolution
    cell: Array  # (layers, 2) int32, indices [x, y] of the cell


@struct.dataclass
class PathNoise:
    """Gumbel noise that selects D random paths; `draw_path` returns the smoothest of these."""

    layers: Array  # (layers + 1,), noise for the choice of the last layer
    ends: Array  # (D, levels, headings, 9), noise for the choice of the last cell
    steps: Array  # (D, layers, 3 (2 SPAN + 1)), noise for the choice of every earlier step


def draw_noise(lattice: Lattice, num: int, seed: int, candidates: int) -> PathNoise:
    """Draw the Gumbel noise of `num` calls of `draw_path`; leaves have the leading axis `num`.

    Each call draws `candidates` random paths and returns the smoothest of them. `lattice` has the
    numbers of time steps, speed levels and headings.
    """
    rng = np.random.default_rng(seed)
    ends = rng.gumbel(size=(num, candidates, lattice.num_speeds, lattice.headings, 9))
    steps = rng.gumbel(size=(num, candidates, lattice.layers, 3 * (2 * SPAN + 1)))
    layers = rng.gumbel(size=(num, lattice.layers + 1))
    return PathNoise(*(host_leaf(each, np.float32) for each in (layers, ends, steps)))


def _velocity(speed: Array, heading: Array, grid: Grid) -> Array:
    angle = (2.0 * np.pi / grid.lattice.headings) * heading.astype(grid.cell.dtype)
    return speed[..., None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def _roughness(path: CellPath, speeds: Array, grid: Grid, num: Array) -> Array:
    velocity = _velocity(speeds[path.level], path.bin, grid)
    change = jnp.sum((velocity[2:] - velocity[:-2]) ** 2, axis=1)
    return jnp.sum(jnp.where(jnp.arange(2, grid.lattice.layers) < num, change, 0.0))


def draw_path(
    grid: Grid,
    reach: ReachSet,
    num: Array,
    cells: Array,
    is_reached: Array,
    noise: PathNoise,
    directness: Array | float,
) -> CellPath:
    """Draw several random paths to a goal, step by step back from the goal; return the smoothest.

    Args:
        grid: grid of the reach set.
        reach: set of cells that the car can reach.
        num: () int32, index of the layer at which the car meets the goal.
        cells: (headings, 9, 2) int32, indices [x, y] of cells around the goal, by `goal_cells`.
        is_reached: (levels, headings, 9) bool, whether the car can be in these cells. If no entry
            is true, the returned path is meaningless.
        noise: noise of one call, without the leading axis of the result of `draw_noise`.
        directness: weight of the squared difference, in forward levels of speed, between the
            velocity at a cell and the mean velocity from the start to this cell. With a greater
            weight, paths are straighter and their speed is more even.
    """
    lattice, dtype = grid.lattice, grid.cell.dtype
    choices = np.meshgrid([-1, 0, 1], np.arange(-SPAN, SPAN + 1), indexing="ij")
    choices = jnp.asarray(np.stack(choices, axis=-1).reshape(-1, 2), jnp.int32)

    cosine, sine = jnp.cos(grid.heading), jnp.sin(grid.heading)
    along = jnp.stack([jnp.stack([cosine, sine]), jnp.stack([-sine, cosine])])
    gap = reach.speeds[-1] - reach.speeds[-2]
    along /= gap
    speeds = reach.speeds / gap  # in forward levels

    def draw(ends: Array, steps: Array) -> CellPath:
        score = ends + jnp.where(jnp.arange(9) == 0, 1.0, 0.0)[None, None]
        best = jnp.argmax(jnp.where(is_reached, score, -jnp.inf))
        level, heading, around = jnp.unravel_index(best, is_reached.shape)

        def back(state: tuple, n: Array) -> tuple[tuple, tuple]:
            level, heading, cell, last = state
            moved = reach.moves[n, level, heading % lattice.headings]
            before = cell - jnp.sum(moved, axis=0, dtype=cell.dtype)
            from_level, turn = level + choices[:, 0], choices[:, 1]
            bits = reach.bits[n]
            is_step = jax.vmap(lambda v, h: bit_at(bits, v, h, before))(from_level, heading - turn)
            is_step &= reach.turns[n, level, turn + SPAN]
            is_step &= reach.changes[n] | (choices[:, 0] == 0)
            turning, uneven = jnp.abs(turn) + jnp.abs(turn - last), jnp.abs(choices[:, 0])
            rough = _TURNING * turning.astype(dtype)
            rough += _UNEVEN * uneven.astype(dtype)
            away = (before - grid.start).astype(dtype) * grid.cell
            rate = away / ((n.astype(dtype) + 0.5) * grid.step)
            mean = jnp.dot(along, rate, precision=lax.Precision.HIGHEST)
            velocity = _velocity(speeds[from_level], heading - turn, grid)
            rough += directness * jnp.sum((velocity - mean[None]) ** 2, axis=-1)
            chosen = jnp.argmax(jnp.where(is_step, steps[n].astype(dtype) - rough, -jnp.inf))
            after = (from_level[chosen], heading - turn[chosen], before, turn[chosen])
            new = jax.tree.map(lambda a, b: jnp.where(n < num, a, b), after, state)
            return new, (level, heading, cell)

        level, heading = level.astype(jnp.int32), heading.astype(jnp.int32)
        end = (level, heading, cells[heading, around], jnp.int32(0))
        _, (levels, bins, passed) = lax.scan(back, end, jnp.arange(lattice.layers), reverse=True)
        return CellPath(level=levels, bin=bins, cell=passed)

    paths = jax.vmap(draw)(noise.ends, noise.steps)
    best = jnp.argmin(jax.vmap(lambda path: _roughness(path, speeds, grid, num))(paths))
    return jax.tree.map(lambda leaf: leaf[best], paths)
