"""Random paths of cells through a reach set, drawn backwards from the goal."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.plane.reach import SPAN, Grid, Lattice, ReachSet, bit_at

# Costs of a step of a path, beside noise.
_TURNING = 0.5  # of a turn by a bin, and of a change of the turn
_UNEVEN = 1.0  # of a change of speed by a level


@struct.dataclass
class CellPath:
    """Speed, heading and cell after every layer of a path through a reach set."""

    level: Array  # (layers,) int32, of speed from one layer to the next
    bin: Array  # (layers,) int32, of heading, not wrapped
    cell: Array  # (layers, 2) int32


@struct.dataclass
class Chance:
    """Gumbel noise of one path, the smoothest of D, or of many paths with a leading axis."""

    layers: Array  # (layers + 1,), on the layer of the end
    ends: Array  # (D, levels, headings, 9), on the cell of the end
    steps: Array  # (D, layers, 3 (2 SPAN + 1)), on the step before


def draw_chance(lattice: Lattice, num: int, seed: int, drawn: int) -> Chance:
    """Draw the noise of paths, the same for all cases."""
    rng = np.random.default_rng(seed)
    ends = rng.gumbel(size=(num, drawn, lattice.levels, lattice.headings, 9))
    steps = rng.gumbel(size=(num, drawn, lattice.layers, 3 * (2 * SPAN + 1)))
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
    """Draw the smoothest of some random paths to a goal; arguments as of `draw_path`."""
    paths = jax.vmap(
        lambda ends, steps: draw_path(grid, reach, num, cells, there, ends, steps, directness)
    )(chance.ends, chance.steps)
    best = jnp.argmin(jax.vmap(lambda path: _roughness(path, grid.lattice, num))(paths))
    return jax.tree.map(lambda leaf: leaf[best], paths)


def _velocity(level: Array, heading: Array, lattice: Lattice) -> Array:
    """Return velocities (..., 2) of levels and bins (...), in levels, along bin 0 and across."""
    angle = (2.0 * np.pi / lattice.headings) * heading
    return level[..., None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def _roughness(path: CellPath, lattice: Lattice, num: Array) -> Array:
    """Return the sum of the squared changes of velocity over two layers, in levels of speed."""
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
    """Draw a random path to a goal, step by step back from the goal.

    Args:
        grid: of the reach set.
        reach: the set.
        num: () int32, the layer that meets the goal.
        cells: of `goal_cells`.
        there: of `goal_cells`; if no cell is there, the path means nothing.
        ends: (levels, headings, 9), noise on the cell of the end.
        steps: (layers, 3 (2 SPAN + 1)), noise on the step before.
        directness: cost of the squared difference between a velocity and the mean velocity of the
            path up to there, in levels of speed. More makes paths straight and even.
    """
    lattice = grid.lattice
    noise = ends + jnp.where(jnp.arange(9) == 0, 1.0, 0.0)  # rather at the goal itself
    best = jnp.argmax(jnp.where(there, noise, -jnp.inf))
    level, heading, around = jnp.unravel_index(best, there.shape)
    choices = jnp.asarray(
        np.stack(
            np.meshgrid([-1, 0, 1], np.arange(-SPAN, SPAN + 1), indexing="ij"), axis=-1
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
        is_step = jax.vmap(lambda v, h: bit_at(bits, v, h, before))(from_level, heading - turn)
        is_step &= reach.turns[n, level, turn + SPAN]
        rough = _TURNING * (jnp.abs(turn) + jnp.abs(turn - last))
        rough += _UNEVEN * jnp.abs(choices[:, 0])
        mean = jnp.dot(along, (before - grid.start) / (n + 0.5), precision=lax.Precision.HIGHEST)
        velocity = _velocity(from_level, heading - turn, lattice)
        rough += directness * jnp.sum((velocity - mean) ** 2, axis=-1)
        chosen = jnp.argmax(jnp.where(is_step, steps[n] - rough, -jnp.inf))
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
