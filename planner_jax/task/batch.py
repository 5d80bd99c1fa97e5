"""Batches of plans: chunks of a few fixed sizes, spread over the devices, round after round.

Padding to fixed sizes keeps a new batch size from compiling the solver anew. After each round the
lanes that are still unsolved are packed together for the next one. Every device solves its lanes
in a loop of its own and waits for no other.
"""

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding

from planner_jax.optimise.multistart import solve_batch
from planner_jax.optimise.problem import Planner, Round
from planner_jax.optimise.status import is_solved, is_unsolved

# Lanes of a device in one call. Few, because every one is a program of its own to compile.
BUCKETS = (16, 128, 1024, 8192, 65536)
_CPU_CHUNK, _GPU_CHUNK = 256, 65536  # what fits the cache of a core, and what fills a GPU
_LANES = PartitionSpec("lanes")


def plan_batch(
    planner: Planner, scenarios: Any, chunk: int | None, devices: Sequence[Any] | None
) -> tuple[Any, Any]:
    """The planner's rounds on B cases, each round on the lanes that are still unsolved.

    Args:
        planner: sizes and switches.
        scenarios: a leading axis of B on every leaf.
        chunk: lanes a device solves in one call; None for what suits it.
        devices: that share the work; None for all local ones.

    Returns:
        plans: with NumPy leaves, or where all leaves of the scenarios are jax arrays, with
            those, so that nothing leaves the devices.
        unsolved: numbers that are all zero if no lane is unsolved.
    """
    mesh = Mesh(np.array(jax.local_devices() if devices is None else devices), ("lanes",))
    resident = all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(scenarios))
    num = _length(scenarios)
    in_one_call = num == _bucket(num, chunk or _default_chunk(planner.rounds[0], mesh))
    # One CPU's memory is the host's: there a thread for each core plans chunks, and they are cut
    # and joined without programs, which would be compiled for every new size.
    if resident and (in_one_call or not _is_one_cpu(mesh)):
        return _plan_resident(planner, scenarios, chunk, mesh)
    plans, unsolved = _plan_from_host(planner, scenarios, chunk, mesh)
    return (jax.device_put(plans, _sharding(mesh)) if resident else plans), unsolved


def _plan_from_host(
    planner: Planner, scenarios: Any, chunk: int | None, mesh: Mesh
) -> tuple[Any, int]:
    """As `plan_batch`, of scenarios in NumPy arrays."""
    scenarios = jax.tree.map(np.asarray, scenarios)
    lanes = np.arange(_length(scenarios))
    plans: Any = None
    for attempt in planner.rounds:
        calls = _calls(lanes, chunk or _default_chunk(attempt, mesh), mesh)
        found = _solved_from_host(planner, attempt, scenarios, [call for call, _ in calls], mesh)
        if plans is None:
            trimmed = [
                jax.tree.map(lambda leaf, n=num: np.asarray(leaf)[:n], part)
                for part, (_, num) in zip(found, calls, strict=True)
            ]
            plans = jax.tree.map(lambda *leaves: np.concatenate(leaves), *trimmed)
        else:
            for (call, num), later in zip(calls, found, strict=True):
                plans = merged(plans, later, call[:num])
        lanes = np.flatnonzero(is_unsolved(plans.status))
        if lanes.size == 0:
            break
    return plans, lanes.size


def _plan_resident(
    planner: Planner, scenarios: Any, chunk: int | None, mesh: Mesh
) -> tuple[Any, Array]:
    """As `plan_batch`, of scenarios in jax arrays; only how many are unsolved comes to the host.

    Every device plans its own share, without asking the others for a lane.
    """
    num = _length(scenarios)
    if num % mesh.size:  # the last lane is there again until all shares are equal
        scenarios = _taken(scenarios, np.arange(-(-num // mesh.size) * mesh.size))
    scenarios = _placed(scenarios, mesh)
    first, *others = planner.rounds
    plans, unsolved = _first_plans(
        planner, first, scenarios, chunk or _default_chunk(first, mesh), mesh
    )
    for attempt in others:
        unsolved.copy_to_host_async()  # on its way as soon as it is known
        most = np.asarray(unsolved).max()  # of the devices
        if most == 0:
            break
        size, before = chunk or _default_chunk(attempt, mesh), plans.status
        for begin in range(0, most, size):
            bucket = _bucket(most - begin, size)
            part, lanes = _cut_unsolved(mesh, bucket, scenarios, before, _number(mesh, begin))
            later, _ = _solve(planner, attempt, mesh, part)
            plans, unsolved = _merged_locally(mesh, plans, later, lanes)
    if num % mesh.size:  # arrays have equal shares or none
        plans = _taken(jax.device_put(plans, mesh.devices[0]), np.arange(num))
    return plans, unsolved


def _first_plans(
    planner: Planner, attempt: Round, scenarios: Any, chunk: int, mesh: Mesh
) -> tuple[Any, Array]:
    """One round on all lanes of every device, chunk by chunk; as `_solve`."""
    share = _length(scenarios) // mesh.size
    if share == _bucket(share, chunk):
        return _solve(planner, attempt, mesh, scenarios)
    found = []
    for begin in range(0, share, chunk):
        part = _cut(mesh, _bucket(share - begin, chunk), scenarios, _number(mesh, begin))
        found.append(_solve(planner, attempt, mesh, part)[0])
    return _joined_locally(mesh, found, share)


def _is_one_cpu(mesh: Mesh) -> bool:
    """Whether the only device is the host itself."""
    return mesh.size == 1 and mesh.devices[0].platform == "cpu"


def _length(tree: Any) -> int:
    return jax.tree.leaves(tree)[0].shape[0]


def _default_chunk(attempt: Round, mesh: Mesh) -> int:
    on_cpu = mesh.devices[0].platform == "cpu"
    return max(128, (_CPU_CHUNK if on_cpu else _GPU_CHUNK) // attempt.starts)


def _bucket(num: int, chunk: int) -> int:
    """Lanes of the call that takes the next of `num` lanes of a device."""
    return next((bucket for bucket in BUCKETS if num <= bucket <= chunk), chunk)


def _calls(lanes: np.ndarray, chunk: int, mesh: Mesh) -> list[tuple[np.ndarray, int]]:
    """The lanes of every call, filled up with its first one, and how many of them count."""
    calls = []
    for begin in range(0, lanes.size, chunk * mesh.size):
        part = lanes[begin : begin + chunk * mesh.size]
        length = _bucket(-(-part.size // mesh.size), chunk) * mesh.size
        calls.append((np.append(part, np.full(length - part.size, part[0])), part.size))
    return calls


def _sharding(mesh: Mesh) -> Sharding:
    """Equal shares of the lanes on every device; for one device what JAX handles quickest."""
    return NamedSharding(mesh, _LANES) if mesh.size > 1 else SingleDeviceSharding(mesh.devices[0])


@functools.lru_cache(maxsize=4096)
def _number(mesh: Mesh, value: int) -> Array:
    """A number that every device has; sent but once, since the way there takes time."""
    whole = PartitionSpec()
    placed = NamedSharding(mesh, whole) if mesh.size > 1 else _sharding(mesh)
    return jax.device_put(np.int32(value), placed)


def _apart(mesh: Mesh, function: Callable, *specs: PartitionSpec) -> Callable:
    """The function of every device's own lanes; arguments are split unless `specs` say else."""
    if mesh.size == 1:
        return function
    # Without the check of replication: the lanes of a device share nothing with another's.
    return jax.shard_map(
        function, mesh=mesh, in_specs=specs or _LANES, out_specs=_LANES, check_vma=False
    )


def _placed(tree: Any, mesh: Mesh) -> Any:
    """The tree with equal shares of its lanes on every device."""
    placed = _sharding(mesh)

    def is_there(leaf: Array) -> bool:
        own = leaf.sharding  # equality is quicker to find out
        return own == placed or own.is_equivalent_to(placed, leaf.ndim)

    if all(map(is_there, jax.tree.leaves(tree))):
        return tree
    return jax.device_put(tree, placed)


def _solved_from_host(
    planner: Planner, attempt: Round, scenarios: Any, calls: list[np.ndarray], mesh: Mesh
) -> list[Any]:
    """One round on the lanes of every call; on one CPU device with a thread for each core.

    One thread more hands over the next call while the others compute.
    """
    threads = min(len(calls), (os.cpu_count() or 1) + 1) if _is_one_cpu(mesh) else 1
    placed = _sharding(mesh)

    def solve(lanes: np.ndarray) -> Any:
        part = jax.device_put(jax.tree.map(lambda leaf: leaf[lanes], scenarios), placed)
        found, _ = _solve(planner, attempt, mesh, part)
        return jax.block_until_ready(found) if threads > 1 else found

    if threads == 1:  # calls return before they are done, so that the next is under way
        return [solve(lanes) for lanes in calls]
    # The first call compiles; the others then find the program in the cache.
    first = solve(calls[0])
    with ThreadPoolExecutor(threads) as pool:
        return [first, *pool.map(solve, calls[1:])]


@functools.partial(jax.jit, static_argnames=("planner", "attempt", "mesh"))
def _solve(planner: Planner, attempt: Round, mesh: Mesh, scenarios: Any) -> tuple[Any, Array]:
    """One round on the lanes of every device, and how many each leaves unsolved, (devices,)."""

    def solve(scenarios: Any) -> tuple[Any, Array]:
        return _counted(solve_batch(planner, attempt, scenarios))

    return _apart(mesh, solve)(scenarios)


@jax.jit
def _taken(tree: Any, lanes: Any) -> Any:
    """Some lanes; the last one for those behind it."""
    return jax.tree.map(lambda leaf: leaf[jnp.minimum(lanes, leaf.shape[0] - 1)], tree)


@functools.partial(jax.jit, static_argnames=("mesh", "size"))
def _cut(mesh: Mesh, size: int, tree: Any, begin: Any) -> Any:
    """The next lanes of every device's share, filled up with its last one."""

    def cut(tree: Any, begin: Array) -> Any:
        return _taken(tree, begin + jnp.arange(size))

    return _apart(mesh, cut, _LANES, PartitionSpec())(tree, begin)


@functools.partial(jax.jit, static_argnames=("mesh", "size"))
def _cut_unsolved(mesh: Mesh, size: int, tree: Any, status: Array, begin: Any) -> tuple[Any, Array]:
    """The next unsolved lanes of every device's share, and where they are.

    Filled up with the last lane, said to be behind the share.
    """

    def cut(tree: Any, status: Array, begin: Array) -> tuple[Any, Array]:
        (num,) = status.shape
        (unsolved,) = jnp.nonzero(is_unsolved(status), size=num, fill_value=num)
        lanes = _taken(unsolved, begin + jnp.arange(size))
        return _taken(tree, lanes), lanes

    return _apart(mesh, cut, _LANES, _LANES, PartitionSpec())(tree, status, begin)


@functools.partial(jax.jit, static_argnames=("mesh", "share"))
def _joined_locally(mesh: Mesh, parts: list[Any], share: int) -> tuple[Any, Array]:
    """One after another the parts of every device, which makes its share; as `_solve`."""

    def join(*parts: Any) -> tuple[Any, Array]:
        return _counted(jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:share], *parts))

    return _apart(mesh, join)(*parts)


def _counted(plans: Any) -> tuple[Any, Array]:
    """The plans, and how many are unsolved, (1,)."""
    return plans, jnp.sum(is_unsolved(plans.status), keepdims=True)


def _better(later: Any, plans: Any) -> Any:
    """Where a later round did better."""
    return is_solved(later.status) | (later.violation < plans.violation)


def merged(plans: Any, later: Any, lanes: np.ndarray) -> Any:
    """The plans, in place, with those of some lanes replaced by later ones that are better."""
    later = jax.tree.map(lambda leaf: np.asarray(leaf)[: lanes.size], later)
    better = _better(later, jax.tree.map(lambda leaf: leaf[lanes], plans))

    def replace(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        old[lanes[better]] = new[better]
        return old

    return jax.tree.map(replace, plans, later)


@functools.partial(jax.jit, static_argnames="mesh")
def _merged_locally(mesh: Mesh, plans: Any, later: Any, lanes: Array) -> tuple[Any, Array]:
    """As on the host, of every device's share, and how many it then has unsolved."""

    def merge(plans: Any, later: Any, lanes: Array) -> tuple[Any, Array]:
        before = _taken(plans, lanes)
        better = _better(later, before)

        def replace(old: Array, new: Array, kept: Array) -> Array:
            chosen = better.reshape(-1, *(1,) * (new.ndim - 1))
            return old.at[lanes].set(jnp.where(chosen, new, kept), mode="drop")

        return _counted(jax.tree.map(replace, plans, later, before))

    return _apart(mesh, merge)(plans, later, lanes)
