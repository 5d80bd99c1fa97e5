"""One attempt (round) of a planner that minimises, with each search as a problem of a batch.

A case may be searched from several starting points, in stages from an easy to a hard problem. Every
search of every case is one lane of a batch. The host cuts the lanes of a stage into calls of one
size. All rounds and stages with equal settings thus share a compiled program.
"""

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh
from jaxtyping import PyTree

from planner_jax.core.compiled import QUICK_OPTIONS, Fixed
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt, mark_bad_input
from planner_jax.core.rules import require_shapes
from planner_jax.optimise.divided import Searches, count_guesses, divide_round, run_searches
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.optimise.settings import Round, Stage, load_stage
from planner_jax.planning.programs import (
    COMPILER_OPTIONS,
    PerDevice,
    is_one_cpu,
    lane_sharding,
    on_devices,
)

# Number of searches in one compiled call on each device. A call lasts until its slowest search
# ends, so a CPU makes few searches in a call. A GPU takes as long for fewer searches.
_CPU_LANES, _GPU_LANES = 16, 8192


def divide_one(planner: Planner, attempt: Attempt, case: PyTree) -> PyTree:
    """Return one case's best plan over an attempt's searches from all starts, in NumPy arrays."""
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], case)
    planner, mesh = on_devices(planner, jax.local_devices()[:1])
    size = 1 if is_one_cpu(mesh) else _GPU_LANES
    return jax.tree.map(lambda leaf: leaf[0], _plan(planner, attempt, mesh, size, batch))


def divide_batch(planner: Planner, attempt: Attempt, mesh: Mesh, cases: PyTree) -> PyTree:
    """Return each case's best plan over an attempt's searches from all starts, in NumPy arrays."""
    is_cpu = mesh.devices[0].platform == "cpu"
    return _plan(planner, attempt, mesh, _CPU_LANES if is_cpu else _GPU_LANES, cases)


def _plan(planner: Planner, attempt: Attempt, mesh: Mesh, lanes: int, cases: PyTree) -> PyTree:
    assert isinstance(planner, OptimisedPlanner) and isinstance(attempt, Round)
    is_cpu, size = mesh.devices[0].platform == "cpu", lanes * mesh.size
    rounds = (*planner.attempts, attempt)
    spec = lane_sharding(mesh)

    def search(stage: Stage, cases: PyTree, index: PyTree, points: PyTree) -> tuple[PyTree, PyTree]:
        guesses, total = count_guesses(rounds, stage), len(index)
        if points is None:
            first = jax.tree.map(lambda leaf: leaf[0], cases)
            start = jax.eval_shape(_guess, planner.with_settings(stage.settings), first)
            points = np.zeros((total, *start.shape), start.dtype)
        loaded, found = load_stage(stage, not is_cpu), []
        for begin in range(0, total, size):
            lanes = np.minimum(np.arange(begin, begin + size), total - 1)
            own = jax.tree.map(lambda leaf, lanes=lanes: leaf[lanes], (cases, index, points))
            own = jax.device_put(Searches(*own), spec)
            found.append(_search_on_devices(mesh, guesses, planner, loaded, own))
        ends = [jax.tree.map(np.asarray, each) for each in found]  # waits for the results
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:total], *ends)

    return mark_bad_input(divide_round(search, attempt, cases), cases)


def _search(
    guesses: int, planner: OptimisedPlanner, loaded: PyTree, searches: Searches
) -> tuple[Array, PyTree]:
    require_shapes(searches.cases)
    stage: PyTree = loaded.attempt if isinstance(loaded, Fixed) else loaded
    return run_searches(planner, stage, guesses, searches)


_search_on_devices = PerDevice(_search, COMPILER_OPTIONS | QUICK_OPTIONS)


@jax.jit
def _guess(planner: OptimisedPlanner, case: PyTree) -> Array:
    return planner.guesses(planner.prepare(case), 1)[0]
