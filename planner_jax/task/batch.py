"""Batches of plans: chunks of a few fixed sizes, spread over the devices, round after round.

Padding to fixed sizes keeps a new batch size from compiling anew. After each round the lanes
that are still unsolved are packed together for the next one. Every device solves its lanes in
a loop of its own and waits for no other.
"""

import functools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from planner_jax.optimise.multistart import solve_batch
from planner_jax.optimise.problem import Planner, Round
from planner_jax.optimise.status import is_solved, is_unsolved

BUCKETS = (16, 64, 256, 1024, 4096, 16384, 32768, 65536)  # lanes of a device in one call
_CPU_CHUNK, _GPU_CHUNK = 256, 65536  # what fits the cache of a core, and what fills a GPU
_LANES = PartitionSpec("lanes")


def plan_batch(
    planner: Planner, scenarios: Any, chunk: int | None, devices: Sequence[Any] | None
) -> Any:
    """The planner's rounds on B cases, each round on the lanes that are still unsolved.

    Args:
        planner: sizes and switches.
        scenarios: a leading axis of B on every leaf.
        chunk: lanes a device solves in one call; None for what suits it.
        devices: that share the work; None for all local ones.

    Returns:
        Plans with NumPy leaves, or where all leaves of the scenarios are jax arrays, with
        those, so that nothing leaves the devices.
    """
    mesh = Mesh(np.array(jax.local_devices() if devices is None else devices), ("lanes",))
    resident = all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(scenarios))
    if not resident:
        scenarios = jax.tree.map(np.asarray, scenarios)
    lanes = np.arange(jax.tree.leaves(scenarios)[0].shape[0])
    plans: Any = None
    for attempt in planner.rounds:
        size = mesh.size * (chunk or _default_chunk(attempt, mesh))
        parts = [lanes[i : i + size] for i in range(0, lanes.size, size)]
        calls = [_padded(part, size, mesh.size) for part in parts]
        found = _solved(planner, attempt, scenarios, calls, mesh)
        if plans is None:
            plans = _joined(found, parts, resident)
        else:
            merge = _merged_on_device if resident else _merged_on_host
            for part, call, later in zip(parts, calls, found, strict=True):
                plans = merge(plans, later, call if resident else part)
        lanes = np.flatnonzero(is_unsolved(np.asarray(plans.status)))
        if lanes.size == 0:
            break
    return plans


def _default_chunk(attempt: Round, mesh: Mesh) -> int:
    on_cpu = mesh.devices[0].platform == "cpu"
    return max(128, (_CPU_CHUNK if on_cpu else _GPU_CHUNK) // attempt.starts)


def _padded(part: np.ndarray, size: int, num_devices: int) -> np.ndarray:
    """The lanes of one call: up to the next bucket of every device the first one again."""
    buckets = (bucket * num_devices for bucket in BUCKETS)
    length = next((b for b in buckets if part.size <= b <= size), size)
    return np.concatenate([part, np.full(length - part.size, part[0])])


def _solved(
    planner: Planner, attempt: Round, scenarios: Any, calls: list[np.ndarray], mesh: Mesh
) -> list[Any]:
    """One round on the lanes of every call; on one CPU device a thread for each core."""
    leaf = jax.tree.leaves(scenarios)[0]
    resident = isinstance(leaf, jax.Array)
    placed = NamedSharding(mesh, _LANES)

    def solve(lanes: np.ndarray) -> Any:
        if not resident:
            part = jax.tree.map(lambda leaf: leaf[lanes], scenarios)
        elif lanes.size == leaf.shape[0] and (np.diff(lanes) == 1).all():
            part = scenarios  # all of them, as they are
        else:
            part = _taken(scenarios, lanes)
        if not resident or leaf.sharding != placed:
            part = jax.device_put(part, placed)
        found = _solve(planner, attempt, mesh, part)
        return jax.block_until_ready(found) if threads > 1 else found

    one_cpu = mesh.size == 1 and mesh.devices[0].platform == "cpu"
    threads = min(len(calls), os.cpu_count() or 1) if one_cpu else 1
    if threads == 1:  # calls return before they are done, so that the next is under way
        return [solve(lanes) for lanes in calls]
    # The first call compiles; the others then find the program in the cache.
    first = solve(calls[0])
    with ThreadPoolExecutor(threads) as pool:
        return [first, *pool.map(solve, calls[1:])]


@functools.partial(jax.jit, static_argnames=("planner", "attempt", "mesh"))
def _solve(planner: Planner, attempt: Round, mesh: Mesh, scenarios: Any) -> Any:
    solve = functools.partial(solve_batch, planner, attempt)
    # Without the check of replication: the lanes of a device share nothing with another's.
    return jax.shard_map(solve, mesh=mesh, in_specs=_LANES, out_specs=_LANES, check_vma=False)(
        scenarios
    )


@jax.jit
def _taken(tree: Any, lanes: jax.Array) -> Any:
    return jax.tree.map(lambda leaf: leaf[lanes], tree)


def _joined(found: list[Any], parts: list[np.ndarray], resident: bool) -> Any:
    """The plans of all calls, without those of the padding."""

    def join(*leaves: Any) -> Any:
        if resident and len(parts) == 1 and leaves[0].shape[0] == parts[0].size:
            return leaves[0]
        if not resident:
            leaves = tuple(np.asarray(leaf) for leaf in leaves)
        trimmed = [leaf[: part.size] for leaf, part in zip(leaves, parts, strict=True)]
        return (jnp if resident else np).concatenate(trimmed)

    return jax.tree.map(join, *found)


def _better(later: Any, plans: Any) -> Any:
    """Where a later round did better."""
    return is_solved(later.status) | (later.violation < plans.violation)


def _merged_on_host(plans: Any, later: Any, lanes: np.ndarray) -> Any:
    """The plans, in place, with those of some lanes replaced by later ones that are better."""
    later = jax.tree.map(lambda leaf: np.asarray(leaf)[: lanes.size], later)
    better = _better(later, jax.tree.map(lambda leaf: leaf[lanes], plans))

    def replace(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        old[lanes[better]] = new[better]
        return old

    return jax.tree.map(replace, plans, later)


@jax.jit
def _merged_on_device(plans: Any, later: Any, lanes: jax.Array) -> Any:
    """As on the host; a lane that pads the call is there more than once, each time the same."""
    before = jax.tree.map(lambda leaf: leaf[lanes], plans)
    better = _better(later, before)

    def replace(old: jax.Array, new: jax.Array, kept: jax.Array) -> jax.Array:
        chosen = better.reshape(-1, *(1,) * (new.ndim - 1))
        return old.at[lanes].set(jnp.where(chosen, new, kept))

    return jax.tree.map(replace, plans, later, before)
