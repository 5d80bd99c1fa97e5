"""Coverage of a library of motions, and a check of its motions by the referee.

A ball passes a cell of the outer and a cell of the inner box around the arm; these cells are a
pair. Coverage is the share of pairs with a stored motion. The referee checks plans independently.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from planner_jax.ball.flight import BallState, drag_free_flight
from planner_jax.baselines.block.library.cells import Tunnels, farthest_crossing, tunnels
from planner_jax.baselines.block.library.planner import LibraryBlock
from planner_jax.baselines.block.library.table import Library, Row, unpack_rows
from planner_jax.core import GRAVITY
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import are_solved
from planner_jax.planning.plan import plan
from planner_jax.referee.block import BlockVerdict, referee_blocks
from planner_jax.robot.arm import shield_inradius
from planner_jax.task.block.case import ANYWHERE, BlockCase

_SPEEDS = (7.0, 10.0)  # [m/s], range of random balls' mean speed from outer to inner box
# [s], time from the end of a stored motion to a random ball's entry into the box around the arm.
_SPARE = 2e-3


@dataclasses.dataclass(frozen=True)
class Coverage:
    """Which motions a library has, from H start poses, for P pairs of cells on two boxes."""

    is_feasible: np.ndarray  # (P,) bool, whether a ball can pass through both cells
    is_centred: np.ndarray  # (P,) bool, whether a ball from the outer cell's centre can pass both
    found: np.ndarray  # (H, P) bool, whether a motion is stored
    # (H, P) bool, whether the shield at the end of the motion blocks all balls through both cells.
    is_sure: np.ndarray

    def share(self, of: np.ndarray) -> np.ndarray:
        """Return for H start poses the fraction of pairs in the mask `of` (P,) with a motion."""
        return (self.found & of).sum(axis=1) / of.sum()


def coverage(library: Library) -> Coverage:
    """Compute for which pairs of cells on two boxes a motion blocks some, or all, balls."""
    scene, found = library.setting.scene, library.found
    tunnel = tunnels(library.table.layout, scene.inner, scene.outer)
    row = unpack_rows(np.asarray(library.table.rows))
    far = np.asarray(_farthest(tunnel.outer, tunnel.inner, row))
    half = float(shield_inradius(library.setting.arm))
    return Coverage(
        is_feasible=tunnel.is_feasible,
        is_centred=tunnel.is_centred,
        found=found,
        # Balls may miss the shield by 0.1 mm, which tolerates rounding errors.
        is_sure=found & (far <= half + 1e-4),
    )


@jax.jit
def _farthest(outer: Array, inner: Array, row: Row) -> Array:
    def one(outer: Array, inner: Array, row: Row) -> Array:
        sides = [row.normal, row.edge, jnp.cross(row.normal, row.edge)]
        return farthest_crossing(outer, inner, jnp.asarray(row.middle), jnp.stack(sides, axis=1))

    of_home = jax.vmap(one)
    return jax.vmap(of_home, (None, None, 0))(outer, inner, row)


@dataclasses.dataclass(frozen=True)
class Check:
    """B random balls through pairs of cells with a stored motion, and the referee's verdicts."""

    cases: BlockCase
    pairs: np.ndarray  # (B,) int, index of the pair of cells that each ball passes
    claimed: np.ndarray  # (B,) bool, whether the planner reports that the ball is blocked
    verdict: BlockVerdict


def check(library: Library, num: int, seed: int = 0, home: int = 0) -> Check:
    """Let the referee, an independent check of plans, judge stored motions for random balls.

    Each ball passes a random pair of cells, on two boxes, with a stored motion, and leaves just
    enough time for this motion.

    Args:
        library: the library, with NumPy leaves.
        num: number of balls. Pairs are drawn without replacement until all have been drawn.
        seed: seed of the pairs and of the balls.
        home: index of the library's start pose at which the arm waits.

    Raises:
        ArgumentError: no motion is stored from this start pose.
    """
    stored = np.flatnonzero(library.found[home])
    if not stored.size:
        raise ArgumentError("library", "motions", verb="have", shown=f"none from home {home}")
    rng = np.random.default_rng(seed)
    shuffled = [rng.permutation(stored) for _ in range(-(-num // stored.size))]
    pairs = np.concatenate(shuffled)[:num]
    scene = library.setting.scene
    tunnel = tunnels(library.table.layout, scene.inner, scene.outer)
    cases = _throw_balls(library, tunnel, pairs, rng, home)
    plans = plan(LibraryBlock(library), cases)
    return Check(
        cases=cases, pairs=pairs, claimed=are_solved(plans), verdict=referee_blocks(cases, plans)
    )


def _throw_balls(
    library: Library, tunnel: Tunnels, pairs: np.ndarray, rng: np.random.Generator, home: int
) -> BlockCase:
    """Return cases of balls through the pairs of cells with numbers `pairs` (B,).

    Each ball flies from a random point of its outer cell to a random point of its inner cell. The
    arm stands at the library's start pose with index `home`.
    """
    num, setting = len(pairs), library.setting
    ends = []
    for corners in (tunnel.outer[pairs], tunnel.inner[pairs]):
        share = rng.uniform(size=(num, 3))
        ends.append(corners[:, 0] + share * (corners[:, 1] - corners[:, 0]))
    path = ends[1] - ends[0]
    span = np.linalg.norm(path, axis=1) / rng.uniform(*_SPEEDS, num)
    vel = path / span[:, None]
    vel[:, 2] += 0.5 * GRAVITY * span
    ball = BallState(pos=jnp.asarray(ends[0], jnp.float32), vel=jnp.asarray(vel, jnp.float32))
    duration = unpack_rows(np.asarray(library.table.rows)[home, pairs]).duration
    before = jax.tree.map(np.asarray, _move_back(ball, jnp.asarray(duration + _SPARE)))

    def repeat(leaf: ArrayLike) -> Array:
        return host_leaf(np.broadcast_to(np.asarray(leaf), (num, *np.shape(leaf))))

    setting = jax.tree.map(repeat, setting)
    constant = lambda value: repeat(np.asarray(value, np.float32))  # noqa: E731
    return BlockCase(
        ball=before,
        gravity=constant(GRAVITY),
        ball_radius=constant(0.0),
        delay=constant(0.0),
        angles=repeat(np.asarray(library.table.homes)[home]),
        rates=repeat(np.zeros(6, np.float32)),
        arm=setting.arm,
        limits=setting.limits,
        ends_at_rest=setting.ends_at_rest,
        offset=constant(ANYWHERE[0]),
        tilt=constant(ANYWHERE[1]),
        scene=setting.scene,
    )


@jax.jit
def _move_back(balls: BallState, times: Array) -> BallState:
    gravity = jnp.asarray(GRAVITY, times.dtype)
    return jax.vmap(drag_free_flight, (0, 0, None))(balls, -times, gravity)
