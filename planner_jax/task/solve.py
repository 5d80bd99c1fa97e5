"""`plan`: one call for one scenario or a hundred thousand.

A batch is cut into chunks that are padded to a few fixed sizes, so that a new batch size does
not compile anew. After each round the unsolved lanes are packed together for the next one.
"""

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.optimise.multistart import solve_round
from planner_jax.optimise.problem import Planner, Round, Scenario
from planner_jax.optimise.status import Status

BUCKETS = (16, 128, 1024, 8192, 65536)


def plan(planner: Planner, scenarios: Scenario, *, chunk: int | None = None) -> Any:
    """Plan one scenario, or a batch of them with a leading axis on every leaf.

    Args:
        planner: sizes and switches, such as `ExactHit()`; its rounds are tried in order, each
            on the lanes that are still unsolved.
        scenarios: a scenario pytree; a batch has one more axis than a single case.
        chunk: lanes solved in one compiled call. The default suits the device.

    Returns:
        The planner's plans with the batch shape of the scenarios, leaves NumPy arrays. Look
        at `status`: a lane that could not be solved says so and holds the best that was found.
    """
    batch = scenarios.batch_shape
    if batch == ():
        return _plan_single(planner, scenarios)
    if len(batch) != 1 or batch[0] == 0:
        raise ValueError(f"scenarios must be one case or a batch of some, got batch shape {batch}")
    num = batch[0]
    host = jax.tree.map(np.asarray, scenarios)
    for name, leaf in zip(_paths(host), jax.tree.leaves(host), strict=True):
        if leaf.shape[:1] != batch:
            raise ValueError(f"scenarios{name} must have {num} lanes, got shape {leaf.shape}")
    plans: Any = None
    lanes = np.arange(num)
    for attempt in planner.rounds:
        solved = _solve_lanes(planner, attempt, host, lanes, chunk or _default_chunk(attempt))
        plans = solved if plans is None else _merge(plans, solved, lanes)
        lanes = np.flatnonzero(_unsolved(plans.status))
        if lanes.size == 0:
            break
    return plans


def is_solved(status: Any) -> Any:
    """Which statuses are those of a plan that meets every limit the planner looked at."""
    return (status == Status.CONVERGED) | (status == Status.FEASIBLE)


def _unsolved(status: np.ndarray) -> np.ndarray:
    """Lanes worth another round: not solved, and not broken either."""
    return ~is_solved(status) & (status != Status.NON_FINITE)


def _paths(tree: Any) -> list[str]:
    return [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(tree)]


def _plan_single(planner: Planner, scenario: Scenario) -> Any:
    best = None
    for attempt in planner.rounds:
        found = _solve_single(planner, attempt, scenario)
        if best is None or is_solved(found.status) or found.violation < best.violation:
            best = found
        if not _unsolved(best.status):
            break
    return best


def _merge(plans: Any, later: Any, lanes: np.ndarray) -> Any:
    """`plans` with the given lanes replaced where the later round did better."""
    better = is_solved(later.status) | (later.violation < plans.violation[lanes])

    def replace(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        old[lanes[better]] = new[better]
        return old

    return jax.tree.map(replace, plans, later)


def _default_chunk(attempt: Round) -> int:
    """Lanes a call: what fits the cache of a core, or what fills a GPU."""
    lanes = 1024 if jax.default_backend() == "cpu" else 65536
    return max(128, lanes // attempt.starts)


def _solve_lanes(
    planner: Planner, attempt: Round, scenarios: Any, lanes: np.ndarray, chunk: int
) -> Any:
    """One round on the given lanes, chunk by chunk, a thread for each core of a CPU."""

    def solve(part: np.ndarray) -> Any:
        size = next((b for b in BUCKETS if b >= min(part.size, chunk)), chunk)
        padded = np.concatenate([part, np.full(size - part.size, part[0])])
        found = _solve_batch(planner, attempt, jax.tree.map(lambda x: x[padded], scenarios))
        return jax.tree.map(lambda x: np.array(x[: part.size]), jax.device_get(found))

    parts = [lanes[i : i + chunk] for i in range(0, lanes.size, chunk)]
    solved = _in_parallel(solve, parts)
    return jax.tree.map(lambda *x: np.concatenate(x), *solved)


def _in_parallel(solve: Callable[[np.ndarray], Any], parts: list[np.ndarray]) -> list[Any]:
    workers = min(len(parts), os.cpu_count() or 1) if jax.default_backend() == "cpu" else 1
    if workers == 1:
        return [solve(part) for part in parts]
    # The first chunk compiles; the others then find the program in the cache.
    first = solve(parts[0])
    with ThreadPoolExecutor(workers) as pool:
        return [first, *pool.map(solve, parts[1:])]


def _solve_single(planner: Planner, attempt: Round, scenario: Scenario) -> Any:
    """One round on one case, its leaves sent and fetched as one vector.

    Each array that crosses into or out of a compiled program costs some microseconds, which
    for one plan would add up to a fifth of the time.
    """
    leaves, treedef = jax.tree.flatten(scenario)
    arrays = [np.asarray(leaf) for leaf in leaves]
    layout = tuple((array.shape, array.dtype) for array in arrays)
    dtype = np.result_type(*(kind for _, kind in layout if np.issubdtype(kind, np.floating)))
    solve, plan_tree, fields = _packed_solver(planner, attempt, treedef, layout, dtype)
    packed = np.asarray(solve(np.concatenate([array.ravel() for array in arrays])))
    return jax.tree.unflatten(
        plan_tree,
        [packed[where].reshape(shape).astype(dtype, copy=False) for where, shape, dtype in fields],
    )


@functools.cache
def _packed_solver(
    planner: Planner,
    attempt: Round,
    treedef: Any,
    layout: tuple[tuple[tuple[int, ...], Any], ...],
    dtype: Any,
) -> tuple[Callable, Any, list[tuple[slice, tuple[int, ...], Any]]]:
    """Compiled solver from vector to vector, and the plan's tree and where its leaves lie."""
    ends = np.cumsum([int(np.prod(shape)) for shape, _ in layout])

    def unpacked(vector: jax.Array) -> Any:
        pieces = jnp.split(vector, ends[:-1])
        shaped = [
            piece.reshape(shape).astype(kind)
            for piece, (shape, kind) in zip(pieces, layout, strict=True)
        ]
        return solve_round(planner, attempt, jax.tree.unflatten(treedef, shaped))

    def packed(vector: jax.Array) -> jax.Array:
        leaves = jax.tree.leaves(unpacked(vector))
        return jnp.concatenate([leaf.ravel().astype(dtype) for leaf in leaves])

    shapes = jax.eval_shape(unpacked, jax.ShapeDtypeStruct((int(ends[-1]),), dtype))
    leaves, plan_tree = jax.tree.flatten(shapes)
    stops = np.cumsum([leaf.size for leaf in leaves]).tolist()
    fields = [
        (slice(stop - leaf.size, stop), leaf.shape, leaf.dtype)
        for stop, leaf in zip(stops, leaves, strict=True)
    ]
    return jax.jit(packed), plan_tree, fields


@functools.partial(jax.jit, static_argnames=("planner", "attempt"))
def _solve_batch(planner: Planner, attempt: Round, scenarios: Any) -> Any:
    return jax.vmap(functools.partial(solve_round, planner, attempt))(scenarios)
