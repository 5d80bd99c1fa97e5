"""How much of what balls can do a library covers, and whether its motions hold."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from planner_jax.ball.flight import BallState, drag_free_flight
from planner_jax.baselines.block.library.cells import GRAVITY, Tunnels, farthest_crossing, tunnels
from planner_jax.baselines.block.library.planner import LibraryBlock
from planner_jax.baselines.block.library.table import Library, Row, unpacked
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import solved
from planner_jax.planning.plan import plan
from planner_jax.referee.block import BlockVerdict, referee_blocks
from planner_jax.task.block.case import ANYWHERE, BlockCase

_SPEEDS = (7.0, 10.0)  # [m/s], of balls between the boxes
_SPARE = 2e-3  # [s], longer than the motion: how long balls are seen before they get into a box


@dataclasses.dataclass(frozen=True)
class Coverage:
    """Which pairs of cells have what, booleans (H, P), one row a home."""

    is_feasible: np.ndarray  # (P,), whether a ball can pass through
    is_centred: np.ndarray  # (P,), whether one from the middle of the outer cell can
    found: np.ndarray  # a motion is stored
    is_sure: np.ndarray  # and its shield blocks the whole tunnel

    def share(self, of: np.ndarray) -> np.ndarray:
        """Return share of some pairs (P,) that have a motion, (H,)."""
        return (self.found & of).sum(axis=1) / of.sum()


def coverage(library: Library) -> Coverage:
    """Return the coverage of a library."""
    scene, found = library.setting.scene, library.found
    tunnel = tunnels(library.table.layout, scene.inner, scene.outer)
    row = unpacked(np.asarray(library.table.rows))
    far = np.asarray(_farthest(tunnel.outer, tunnel.inner, row))
    half = float(np.asarray(library.setting.arm.shield_half))
    return Coverage(
        is_feasible=tunnel.is_feasible,
        is_centred=tunnel.is_centred,
        found=found,
        # Between the corners of a shield, to a tenth of a millimetre.
        is_sure=found & (far <= half + 1e-4),
    )


@jax.jit
def _farthest(outer: Array, inner: Array, row: Row) -> Array:
    """Return `farthest_crossing` of every home's rows, (H, P) [m]."""

    def one(outer: Array, inner: Array, row: Row) -> Array:
        sides = [row.normal, row.edge, jnp.cross(row.normal, row.edge)]
        return farthest_crossing(outer, inner, jnp.asarray(row.middle), jnp.stack(sides, axis=1))

    of_home = jax.vmap(one)
    return jax.vmap(of_home, (None, None, 0))(outer, inner, row)


@dataclasses.dataclass(frozen=True)
class Check:
    """Random balls through pairs with a stored motion, each just late enough for it."""

    cases: BlockCase
    pairs: np.ndarray  # (B,) int, their pairs of cells
    claimed: np.ndarray  # (B,) bool, whether the planner says that it blocks them
    verdict: BlockVerdict


def check(library: Library, num: int, seed: int = 0, home: int = 0) -> Check:
    """Have the referee judge stored motions, as answers to random balls through their tunnels.

    Args:
        library: NumPy leaves.
        num: how many; pairs are drawn without being put back until all have been drawn.
        seed: of pairs and balls.
        home: the place of one.

    Raises:
        ValueError: nothing is stored from that home.
    """
    stored = np.flatnonzero(library.found[home])
    if not stored.size:
        raise ArgumentError("library", "motions", verb="have", shown=f"none from home {home}")
    rng = np.random.default_rng(seed)
    shuffled = [rng.permutation(stored) for _ in range(-(-num // stored.size))]
    pairs = np.concatenate(shuffled)[:num]
    scene = library.setting.scene
    tunnel = tunnels(library.table.layout, scene.inner, scene.outer)
    cases = _thrown(library, tunnel, pairs, rng, home)
    plans = plan(LibraryBlock(library), cases)
    return Check(
        cases=cases, pairs=pairs, claimed=solved(plans), verdict=referee_blocks(cases, plans)
    )


def _thrown(
    library: Library, tunnel: Tunnels, pairs: np.ndarray, rng: np.random.Generator, home: int
) -> BlockCase:
    """Return balls from anywhere on outer cells to anywhere on inner ones."""
    num, setting = len(pairs), library.setting
    ends = []
    for corners in (tunnel.outer[pairs], tunnel.inner[pairs]):
        share = rng.uniform(size=(num, 3))
        ends.append(corners[:, 0] + share * (corners[:, 1] - corners[:, 0]))
    way = ends[1] - ends[0]
    span = np.linalg.norm(way, axis=1) / rng.uniform(*_SPEEDS, num)
    vel = way / span[:, None]
    vel[:, 2] += 0.5 * GRAVITY * span
    ball = BallState(pos=jnp.asarray(ends[0], jnp.float32), vel=jnp.asarray(vel, jnp.float32))
    duration = unpacked(np.asarray(library.table.rows)[home, pairs]).duration
    before = jax.tree.map(np.asarray, _earlier(ball, jnp.asarray(duration + _SPARE)))

    def shared(leaf: ArrayLike) -> Array:
        return host_leaf(np.broadcast_to(np.asarray(leaf), (num, *np.shape(leaf))))

    setting = jax.tree.map(shared, setting)
    same = lambda value: shared(np.asarray(value, np.float32))  # noqa: E731
    return BlockCase(
        ball=before,
        gravity=same(GRAVITY),
        delay=same(0.0),
        angles=shared(np.asarray(library.table.homes)[home]),
        rates=shared(np.zeros(6, np.float32)),
        arm=setting.arm,
        limits=setting.limits,
        ends_at_rest=setting.ends_at_rest,
        offset=same(ANYWHERE[0]),
        tilt=same(ANYWHERE[1]),
        scene=setting.scene,
    )


@jax.jit
def _earlier(balls: BallState, times: Array) -> BallState:
    """Return balls (B,) so much time (B,) [s] before."""
    gravity = jnp.asarray(GRAVITY, times.dtype)
    return jax.vmap(drag_free_flight, (0, 0, None))(balls, -times, gravity)
