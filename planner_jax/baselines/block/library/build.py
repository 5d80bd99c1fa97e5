"""Build libraries of arm motions that block balls; repair them after an obstacle has moved."""

import contextlib
import dataclasses
import functools
import io
import json
import os
import re
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike
from tqdm import tqdm

from planner_jax.baselines.block.library.cells import Layout, Tunnels, tunnels
from planner_jax.baselines.block.library.file import BUILD_VERSION, LARGEST, save_library
from planner_jax.baselines.block.library.insat_pairs import plan_pairs_by_insat
from planner_jax.baselines.block.library.pairs import (
    BentPair,
    PairCase,
    PairPlan,
    PairPlanner,
    StraightPair,
)
from planner_jax.baselines.block.library.table import (
    Library,
    Row,
    Setting,
    fingerprint,
    library_of,
    pack_rows,
    pieces_of,
    unpack_rows,
    with_scene,
)
from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.choices import require
from planner_jax.core.plan_files import UNREADABLE
from planner_jax.core.protocol import are_solved
from planner_jax.host.files import is_scratch, read_plain, replacing
from planner_jax.planning.plan import plan
from planner_jax.robot.arm import shield_pose
from planner_jax.robot.arm_clearance import least_clearances
from planner_jax.robot.arm_motion import angles_at
from planner_jax.robot.arm_scene import Scene
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.search.attempts import read_learned_starts

# Indices of initial guesses of arm motions for least squares (file `learned_starts.json`). A build
# of a library first uses `STARTS` in this order; a repair, after an obstacle has moved, first uses
# the old motion and `REPAIR_STARTS`. Pairs of cells that still lack a motion get further guesses.
STARTS, REPAIR_STARTS = (2, 0, 1, 3, 4, 5), (2,)
# [s] A stored motion is planned again if, without obstacles, the arm could block a ball that comes
# earlier by this time.
_WORTH = 0.03
# Names of the planners of motions -> number of pairs that are planned and written to disk as one
# part; None for the number of `portions`.
PLANNERS = {"least-squares": None, "insat": 16}
_CHECKED_AT_ONCE = 1024  # number of stored motions whose distances are computed in one batch


@dataclasses.dataclass(frozen=True)
class Portions:
    """Batch sizes for planning pairs of cells (one of the outer, one of the inner box)."""

    pairs: int  # number of pairs that are planned and written to disk as one part
    lanes: tuple[int, int]  # small and large batch size of one planner call, for each device
    # Number of initial guesses of a pair in one call. A single guess saves work on a CPU, since the
    # search stops at the first success. A GPU plans from many guesses in nearly the same time.
    starts: int


_ON_CPU = Portions(256, (16, 16), 1)
_ON_GPU = Portions(32768, (512, 8192), 16)
_FEW = 6  # number of planner calls of the small size that take as long as one of the large size


@dataclasses.dataclass(frozen=True)
class _Motions:
    """For each of P pairs of cells the best motion so far, which blocks the earliest ball."""

    # (P, 6 K + 1): rates of 6 joints at K knots, times the duration [rad]; then the duration [s].
    point: np.ndarray
    # (P,) [s], earliest entry into the outer box of a ball that the motion blocks; inf without one.
    entry: np.ndarray
    quickest: np.ndarray  # (P,) [s], earliest entry that can be blocked without obstacles


def build(
    path: str | os.PathLike,
    setting: Setting,
    homes: ArrayLike,
    layout: Layout,
    *,
    planner: str = "least-squares",
    progress: bool = True,
) -> Library:
    """Plan for all pairs of cells that a ball can pass through, and write the library.

    Until the library is complete, the planned parts are stored in a folder next to the file, with
    the ending ".parts". After an interruption, the same call continues from these parts and builds
    the same library.

    Args:
        path: path of the library file.
        setting: arm, limits and scene, with NumPy leaves.
        homes: (H, 6) [rad], joint angles of one or more poses at which motions start.
        layout: the division of both boxes around the arm into cells.
        planner: a key of `PLANNERS`: "least-squares" for `plan_pairs`, or "insat" for the motions
            of [Natarajan2024, Algorithm 1].
        progress: show a progress bar on the standard error stream.

    Raises:
        ArgumentError: the arm touches something at a start pose.
        OSError: the file or the folder cannot be written.
    """
    homes = np.atleast_2d(np.asarray(homes, np.float32))
    _require_free(setting, homes)
    tunnel = tunnels(layout, setting.scene.inner, setting.scene.outer)
    feasible = np.flatnonzero(tunnel.is_feasible)
    parts = _Parts(Path(f"{os.fspath(path)}.parts"), setting, homes, layout, planner)
    size, plan_rows = PLANNERS[planner] or portions().pairs, plan_pairs
    if planner == "insat":
        plan_rows = _plan_rows_by_insat
    work = [
        (k, feasible[begin : begin + size])
        for k in range(len(homes))
        for begin in range(0, len(feasible), size)
    ]
    rows = _empty_rows(len(homes), layout, StraightPair(setting, homes[0]))
    rule = f"of stored motions of at most {LARGEST // 2} bytes"
    require(rows.nbytes <= LARGEST // 2, "homes", rule, shown=f"{rows.nbytes} bytes")
    with _bar(len(homes) * len(feasible), "pairs", progress) as bar:
        for number, (k, pairs) in enumerate(work):
            found = parts.read(number)
            if found is None:
                found = plan_rows(setting, homes[k], tunnel, pairs)
                parts.write(number, found)
            rows[k, pairs] = found
            bar.update(len(pairs))
    library = library_of(rows, homes, layout, setting)
    save_library(path, library)
    parts.remove()
    return library


def repair(
    library: Library, scene: Scene, *, retry: bool = False, progress: bool = True
) -> tuple[Library, np.ndarray]:
    """Return the library for another scene, in which colliding motions are planned again.

    Args:
        library: library of a scene with the same boxes around the arm.
        scene: the new scene.
        retry: also plan for pairs of cells that have no motion.
        progress: show a progress bar on the standard error stream.

    Returns:
        The library with NumPy leaves, and which motions from H start poses for P pairs of cells
        were planned again, (H, P) bool. All other motions are unchanged, bit for bit.

    Raises:
        ArgumentError: a box of the scene differs from the library's, or the arm touches something
            at a start pose.
    """
    table, setting = library.table, with_scene(library, scene).setting
    _require_free(setting, table.homes)
    rows = np.array(table.rows)
    tunnel = tunnels(table.layout, scene.inner, scene.outer)
    touched = np.zeros(rows.shape[:2], bool)
    for k, home in enumerate(np.asarray(table.homes)):
        stored = np.flatnonzero(library.found[k])
        touched[k, stored] = ~_is_free(setting, home, rows[k, stored])
        if retry:
            touched[k] |= tunnel.is_feasible & ~library.found[k]
    size = portions().pairs
    with _bar(int(touched.sum()), "pairs", progress) as bar:
        for k, home in enumerate(np.asarray(table.homes)):
            anew = np.flatnonzero(touched[k])
            for begin in range(0, len(anew), size):
                pairs = anew[begin : begin + size]
                rows[k, pairs] = plan_pairs(setting, home, tunnel, pairs, rows[k, pairs])
                bar.update(len(pairs))
    return library_of(rows, table.homes, table.layout, setting), touched


def portions() -> Portions:
    """Return how many pairs of cells on two boxes are planned at a time, by a CPU or a GPU."""
    return _ON_CPU if jax.default_backend() == "cpu" else _ON_GPU


def _require_free(setting: Setting, homes: ArrayLike) -> None:
    for k, home in enumerate(np.asarray(homes)):
        near = float(_nearest(setting, home[None, None])[0])
        shown = f"{near:.3g} m to the nearest obstacle at home {k}"
        require(near > 0.0, "homes", "free", shown=shown)


def plan_pairs(
    setting: Setting,
    home: np.ndarray,
    tunnel: Tunnels,
    pairs: np.ndarray,
    old: np.ndarray | None = None,
) -> np.ndarray:
    """Plan motions from one start pose for N pairs of cells; return rows of the library's table.

    A pair is one cell on each of the two boxes around the arm. `StraightPair` tries motions in
    which all joints move in proportion. `BentPair` then bends motions around obstacles, for pairs
    without a motion, or whose motion blocks only balls that come 0.03 s later than without
    obstacles. Pairs that still have no motion get both steps again, with less accurate contacts.

    Args:
        setting: arm, limits and scene, with NumPy leaves.
        home: (6,) [rad], joint angles at which motions start.
        tunnel: tunnels (spaces between the two cells) of all pairs.
        pairs: (N,), numbers of the pairs to plan for.
        old: (N, W), the pairs' table rows, of length W, for another scene: the initial guesses.
    """
    straight = StraightPair(setting, host_leaf(home))
    bent = BentPair(setting, host_leaf(home))
    outer, inner = (each[pairs].astype(np.float32) for each in (tunnel.outer, tunnel.inner))
    given = np.zeros((len(pairs), 6 * straight.online.pieces + 1), np.float32)
    has_old = np.zeros(len(pairs), bool)
    if old is not None:
        row = unpack_rows(old)
        has_old = np.isfinite(row.duration)
        given[has_old, :-1] = row.steps[has_old].reshape(has_old.sum(), -1)
        given[has_old, -1] = row.duration[has_old]
    found = _Motions(
        point=np.zeros_like(given),
        entry=np.full(len(pairs), np.inf, np.float32),
        quickest=np.full(len(pairs), np.inf, np.float32),
    )

    def improve(
        planner: PairPlanner, some: np.ndarray, starts: Sequence[int], is_coarse: bool
    ) -> None:
        if not some.size:
            return
        lanes = np.repeat(some, len(starts))
        start = np.tile(np.asarray(starts, np.int32), len(some))
        coarse = np.full(len(lanes), is_coarse)
        leaves = (outer[lanes], inner[lanes], coarse, found.entry[lanes], start, given[lanes])
        plans = _plan_batch(planner, PairCase(*map(host_leaf, leaves)))
        cost = np.where(are_solved(plans), plans.cost, np.inf).reshape(len(some), -1)
        first = np.arange(0, len(lanes), len(starts)) + np.argmin(cost, axis=1)
        cost = np.min(cost, axis=1)
        better = cost < found.entry[some]
        found.point[some[better]] = plans.point[first[better]]
        found.entry[some[better]] = cost[better]
        found.quickest[some] = plans.quickest[first]

    improving = STARTS if old is None else (-1, *REPAIR_STARTS)
    remaining = [start for start in STARTS if start not in improving]
    others = [start for start in range(len(read_learned_starts()[0])) if start not in STARTS]
    for is_coarse in (False, True):
        left = np.isinf(found.entry)
        improve(straight, np.flatnonzero(left), [0], is_coarse)
        for starts in (*_groups(improving), *_groups(remaining + others * is_coarse)):
            with np.errstate(invalid="ignore"):
                hard = left & ~(found.entry - found.quickest <= _WORTH)
            if starts[0] not in improving:
                hard &= np.isinf(found.entry)
            hard &= np.isfinite(found.quickest) & (has_old if tuple(starts) == (-1,) else True)
            improve(bent, np.flatnonzero(hard), starts, is_coarse)
    return _rows_of(straight, found)


def _plan_rows_by_insat(
    setting: Setting, home: np.ndarray, tunnel: Tunnels, pairs: np.ndarray
) -> np.ndarray:
    point, entry = plan_pairs_by_insat(setting, home, tunnel, pairs)
    found = _Motions(point=point, entry=entry, quickest=entry)
    return _rows_of(StraightPair(setting, host_leaf(home)), found)


def _groups(starts: Sequence[int]) -> list[Sequence[int]]:
    num = portions().starts
    return [starts[begin : begin + num] for begin in range(0, len(starts), num)]


def _plan_batch(planner: PairPlanner, cases: PairCase) -> PairPlan:
    """Plan a batch in calls of two sizes (small, large), so that only two programs are compiled."""
    num, devices = len(cases.best), jax.local_device_count()
    few, many = portions().lanes
    lanes = few if num <= _FEW * few * devices else many
    whole = -(-num // (lanes * devices)) * lanes * devices
    # Copies of the last case fill the batch to a size that is compiled already.
    filled = jax.tree.map(lambda leaf: leaf[np.minimum(np.arange(whole), num - 1)], cases)
    plans = plan(planner, filled, chunk=lanes)
    return jax.tree.map(lambda leaf: leaf[:num], plans)


def _rows_of(planner: PairPlanner, found: _Motions) -> np.ndarray:
    stored = np.isfinite(found.entry)
    pieces = planner.online.pieces
    steps = found.point[:, :-1].reshape(-1, pieces, 6).copy()
    if planner.setting.ends_at_rest:
        steps[:, -1] = 0.0
    steps[~stored] = 0.0
    ends = [_ends(planner.setting, planner.home, some) for some in _in_parts(steps)]
    parts = (np.concatenate(each)[: len(steps)] for each in zip(*ends, strict=True))
    rotation, middle = parts
    duration = np.where(stored, found.point[:, -1], np.inf)
    leaves = (steps, duration, middle, rotation[:, :, 0], rotation[:, :, 1])
    return pack_rows(Row(*map(host_leaf, leaves)))


def _in_parts(array: np.ndarray) -> list[np.ndarray]:
    """Split an array into parts of `_CHECKED_AT_ONCE` rows; repeat the last row to fill a part."""
    num = -(-len(array) // _CHECKED_AT_ONCE) * _CHECKED_AT_ONCE
    filled = array[np.minimum(np.arange(num), len(array) - 1)]
    return list(filled.reshape(-1, _CHECKED_AT_ONCE, *array.shape[1:]))


@jax.jit
def _ends(setting: Setting, home: Array, steps: Array) -> tuple[Array, Array]:
    def end(steps: Array) -> tuple[Array, Array]:
        angles = angles_at(home, jnp.zeros_like(home), steps, (1.0,))[0]
        return shield_pose(setting.arm, angles)

    return jax.vmap(end)(steps)


def _is_free(setting: Setting, home: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return which of N stored motions keep the least distance from obstacles, (N,) bool."""
    online = OnlineBlock()
    if not len(rows):
        return np.zeros(0, bool)
    shares = tuple(np.arange(1, online.checked + 1) / online.checked)
    steps = unpack_rows(rows).steps
    near = [
        _nearest_on_motion(setting, home, some, shares) for some in _in_parts(np.asarray(steps))
    ]
    # The tolerance 1e-5 m is greater than the rounding errors of the distances.
    return np.concatenate(near)[: len(rows)] >= online.margin - 1e-5


@functools.partial(jax.jit, static_argnames="shares")
def _nearest_on_motion(setting: Setting, home: Array, steps: Array, shares: tuple) -> Array:
    at = lambda steps: angles_at(home, jnp.zeros_like(home), steps, shares)  # noqa: E731
    return _nearest(setting, jax.vmap(at)(steps))


@jax.jit
def _nearest(setting: Setting, angles: Array) -> Array:
    """Return the least obstacle distance (N,) [m] of each of N sequences of S poses (N, S, 6)."""
    flat = least_clearances(setting.arm, setting.scene, angles.reshape(-1, 6))
    return jnp.min(flat.reshape(angles.shape[:2]), axis=1)


def _empty_rows(homes: int, layout: Layout, planner: PairPlanner) -> np.ndarray:
    pieces = planner.online.pieces
    rows = np.zeros((homes, layout.num_pairs, 6 * pieces + 10), np.float32)
    rows[..., 6 * pieces] = np.inf
    assert pieces_of(rows) == pieces
    return rows


def _bar(total: int, unit: str, progress: bool) -> tqdm:
    return tqdm(total=total, unit=f" {unit}", desc="library", disable=not progress)


class _Parts:
    def __init__(
        self, folder: Path, setting: Setting, homes: np.ndarray, layout: Layout, planner: str
    ):
        self._folder = folder
        header = {
            "version": f"{BUILD_VERSION} {planner}",
            "fingerprint": fingerprint(setting),
            "homes": homes.tolist(),
            "layout": dataclasses.asdict(layout),
            "device": jax.default_backend(),  # determines the number of pairs in a file
        }
        text = json.dumps(header, sort_keys=True)
        known = folder / "what.json"
        found, is_own = "", not os.path.lexists(folder)
        if folder.is_dir() and not folder.is_symlink():
            is_own = not any(folder.iterdir())
            with contextlib.suppress(OSError, ValueError, TypeError, RecursionError):
                found = read_plain(known).decode(errors="replace")
                is_own = set(header) <= set(json.loads(found))
        rule = f"a path beside which {folder.name} holds parts of a library alone"
        require(is_own, "library", rule, shown=f"another folder {str(folder)!r}")
        # Delete parts that an interrupted build of another library or code version has left.
        if found != text:
            self.remove()
            folder.mkdir(parents=True, exist_ok=True)
            with replacing(known) as scratch:
                scratch.write_text(text)

    def read(self, number: int) -> np.ndarray | None:
        """Return the rows of a part; None if there is no part that can be read."""
        path = self._folder / f"{number:05d}.npy"
        try:
            return np.load(io.BytesIO(read_plain(path)), allow_pickle=False)
        except UNREADABLE:
            return None

    def write(self, number: int, rows: np.ndarray) -> None:
        path = self._folder / f"{number:05d}.npy"
        with replacing(path) as scratch, open(scratch, "wb") as file:
            np.save(file, rows, allow_pickle=False)

    def remove(self) -> None:
        """Remove the files of all parts, and the folder unless it holds other files."""
        for path in self._folder.iterdir() if self._folder.exists() else ():
            if is_scratch(path) or re.fullmatch(r"[0-9]{5,}\.npy|what\.json", path.name):
                path.unlink()
        with contextlib.suppress(OSError):
            self._folder.rmdir()
