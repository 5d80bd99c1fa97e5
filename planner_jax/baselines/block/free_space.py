"""Collision checks of joint angles in batches, called by the search planners on the host.

A search checks few poses of the arm at a time. Batches are padded to one of a few fixed sizes, so
that only one program for each size has to be compiled.
"""

import functools
from collections.abc import Hashable

import jax
import numpy as np
from jax import Array

from planner_jax.robot.arm import Arm
from planner_jax.robot.arm_clearance import least_clearances
from planner_jax.robot.arm_scene import Scene
from planner_jax.task.block.case import BlockCase

# [rad], joint-space distance between samples of an edge, as in the code that the authors of
# [Natarajan2024] published (github.com/sbpl/parallel_search).
RESOLUTION = 0.05 / 3.0


@functools.cache
def _sizes() -> tuple[int, ...]:
    """Return the batch sizes for which programs are compiled; a GPU also has a large one."""
    return (1, 64, 256, 1024, *(() if jax.default_backend() == "cpu" else (16384,)))


@jax.jit
def _nearest(arm: Arm, scene: Scene, angles: Array) -> Array:
    """Return the arm's distance (N,) [m] from obstacles and itself, for N joint poses (N, n)."""
    return least_clearances(arm, scene, angles)


@functools.cache
def _compile(tree: Hashable, layout: tuple, dtype: np.dtype) -> None:
    """Compile the programs of all batch sizes before a search, so that compiling is not timed.

    `tree` is the pytree structure of (arm, scene), `layout` the shape and type of each leaf.
    """
    arm, scene = jax.tree.unflatten(tree, [np.zeros(*leaf) for leaf in layout])
    for size in _sizes():
        _nearest(arm, scene, np.zeros((size, arm.num), dtype))


class FreeSpace:
    """Checks that an arm's joint angles are within limits and keep a distance from obstacles."""

    def __init__(self, case: BlockCase, margin: float) -> None:
        """Compile the checks; `margin` [m] is the least obstacle distance of a free pose."""
        self.lower, self.upper = np.asarray(case.arm.lower), np.asarray(case.arm.upper)
        self._dtype = np.asarray(case.angles).dtype
        self._arm, self._scene = jax.device_put((case.arm, case.scene))
        self._margin = margin
        leaves, tree = jax.tree.flatten((case.arm, case.scene))
        _compile(tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves), self._dtype)

    def is_free(self, angles: np.ndarray) -> np.ndarray:
        """Return which of N poses (N, n) [rad] are within limits and collision-free, (N,) bool."""
        num, begin, gaps = len(angles), 0, []
        while begin < num:
            size = next((size for size in _sizes() if size >= num - begin), _sizes()[-1])
            some = angles[begin : begin + size]
            filled = np.empty((size, len(self.lower)), self._dtype)
            filled[: len(some)], filled[len(some) :] = some, some[-1]
            gaps.append(np.asarray(_nearest(self._arm, self._scene, filled))[: len(some)])
            begin += size
        is_within = np.all((angles >= self.lower) & (angles <= self.upper), axis=1)
        return is_within & (np.concatenate(gaps) >= self._margin)

    def are_edges_free(self, begins: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return which straight joint motions are free, without testing their starts, (N,) bool.

        Motion k leads from `begins[k]`, or from `begins` if its shape is (6,), to `ends[k]` [rad].
        """
        begins = np.broadcast_to(begins, ends.shape)
        lengths = np.linalg.norm(ends - begins, axis=1)
        counts = np.maximum(np.ceil(lengths / RESOLUTION - 1e-6), 1.0).astype(int)
        edge = np.repeat(np.arange(len(ends)), counts)
        number = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
        share = (number / counts[edge])[:, None]
        angles = begins[edge] + share * (ends - begins)[edge]
        # The last and every eighth sample of a motion are checked first: they reject most motions.
        is_first = (number % 8 == 0) | (number == counts[edge])
        found = np.ones(len(ends), bool)
        for some in (is_first, ~is_first):
            some = some & found[edge]
            if some.any():
                found[edge[some][~self.is_free(angles[some])]] = False
        return found

    def is_motion_free(self, coeffs: np.ndarray, durations: np.ndarray) -> bool:
        """Return whether a piecewise polynomial of the joint angles is collision-free.

        It is checked at samples that are at most `RESOLUTION` apart in joint space.

        Args:
            coeffs: (M, D + 1, n), M pieces of degree D for n joints, lowest power of time first.
            durations: (M,) [s], durations of the pieces.
        """
        rough = _sample_pieces(coeffs, durations, np.full(len(durations), 8))
        lengths = np.linalg.norm(
            np.diff(rough.reshape(-1, 9, rough.shape[-1]), axis=1), axis=2
        ).sum(axis=1)
        counts = np.maximum(np.ceil(1.1 * lengths / RESOLUTION), 1.0).astype(int)
        return bool(self.is_free(_sample_pieces(coeffs, durations, counts)).all())


def _sample_pieces(coeffs: np.ndarray, durations: np.ndarray, counts: np.ndarray) -> np.ndarray:
    piece = np.repeat(np.arange(len(counts)), counts + 1)
    number = np.arange(len(piece)) - np.repeat(np.cumsum(counts + 1) - counts - 1, counts + 1)
    time = (number / counts[piece] * durations[piece])[:, None]
    angles = np.zeros((len(piece), coeffs.shape[2]))
    for k in range(coeffs.shape[1] - 1, -1, -1):
        angles = angles * time + coeffs[piece, k]
    return angles
