"""Batches in jax arrays: nothing leaves the devices but how many lanes are unsolved."""

import functools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from planner_jax.core.protocol import Attempt, Status, is_unsolved, out_of_time
from planner_jax.host.threads import as_here
from planner_jax.planning.layout import LANES, Sizes, apart, length, number, placed, sizes_of
from planner_jax.planning.programs import COMPILED, counted, program_of, solve_on_devices
from planner_jax.planning.progress import Watch
from planner_jax.planning.select import better_of


def plan_resident(
    planner: Any,
    attempts: Sequence[Attempt],
    cases: Any,
    chunk: int | None,
    mesh: Mesh,
    watch: Watch,
) -> tuple[Any, Array]:
    """As `plan_batch`, of cases in jax arrays; only how many are unsolved comes to the host.

    Every device plans its own share, without asking the others for a lane.
    """
    num = length(cases)
    if num % mesh.size:  # the last lane is there again until all shares are equal
        cases = _taken(cases, np.arange(-(-num // mesh.size) * mesh.size))
    cases = placed(cases, mesh)
    first, *others = attempts
    sizes = sizes_of(planner, first, chunk, mesh)
    watch.tell(planner, first, 0, num)
    plans, unsolved = _first_plans(planner, first, cases, sizes, mesh)
    for attempt in others:
        before, due = plans.status, unsolved
        if attempt.within is not None:
            before, due = _due(mesh, attempt.within, plans)
        due.copy_to_host_async()  # on its way as soon as it is known
        most = np.asarray(due).max()  # of the devices
        if most == 0:
            continue
        if watch.is_over:
            plans = out_of_time(plans, attempt.is_due(plans))
            break
        watch.tell(planner, attempt, 0, np.asarray(due).sum())
        sizes = sizes_of(planner, attempt, chunk, mesh)
        for begin, size in sizes.cuts(most):
            part, lanes = _cut_unsolved(mesh, size, cases, before, number(mesh, begin))
            later, _ = solve_on_devices(planner, attempt, mesh, part)
            plans, unsolved = _merged_locally(mesh, plans, later, lanes)
    if num % mesh.size:  # arrays have equal shares or none
        plans = _taken(jax.device_put(plans, mesh.devices[0]), np.arange(num))
    return plans, unsolved


def _first_plans(
    planner: Any, attempt: Attempt, cases: Any, sizes: Sizes, mesh: Mesh
) -> tuple[Any, Array]:
    """One attempt at all lanes of every device, chunk by chunk; as `solve_on_devices`."""
    share = length(cases) // mesh.size
    if share == sizes.next(share):
        return solve_on_devices(planner, attempt, mesh, cases)
    cuts = list(sizes.cuts(share))

    def solve(begin: int, size: int) -> Any:
        part = _cut(mesh, size, cases, number(mesh, begin))
        return solve_on_devices(planner, attempt, mesh, part)[0]

    programs = {size: program_of(planner, attempt, size, cases) for _, size in cuts}
    found: dict[int, Any] = {}
    if len(set(programs.values()) - COMPILED) > 1:  # compiled at the same time
        firsts = {size: begin for begin, size in reversed(cuts)}
        with ThreadPoolExecutor(len(firsts)) as pool:
            made = pool.map(as_here(solve), firsts.values(), firsts)
            found = dict(zip(firsts.values(), made, strict=True))
        COMPILED.update(programs.values())
    parts = [found[begin] if begin in found else solve(begin, size) for begin, size in cuts]
    return _joined_locally(mesh, parts, share)


@jax.jit
def _taken(tree: Any, lanes: Any) -> Any:
    """Some lanes; the last one for those behind it."""
    return jax.tree.map(lambda leaf: leaf[jnp.minimum(lanes, leaf.shape[0] - 1)], tree)


@functools.partial(jax.jit, static_argnames=("mesh", "size"))
def _cut(mesh: Mesh, size: int, tree: Any, begin: Any) -> Any:
    """The next lanes of every device's share, filled up with its last one."""

    def cut(tree: Any, begin: Array) -> Any:
        return _taken(tree, begin + jnp.arange(size))

    return apart(mesh, cut, LANES, PartitionSpec())(tree, begin)


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

    return apart(mesh, cut, LANES, LANES, PartitionSpec())(tree, status, begin)


@functools.partial(jax.jit, static_argnames=("mesh", "within"))
def _due(mesh: Mesh, within: float, plans: Any) -> tuple[Array, Array]:
    """Statuses, and how many are unsolved, (devices,), as if plans farther off were solved."""

    def due(plans: Any) -> tuple[Array, Array]:
        near = plans.violation <= within
        status = jnp.where(near, plans.status, jnp.full_like(plans.status, Status.FEASIBLE))
        return status, jnp.sum(is_unsolved(status), keepdims=True)

    return apart(mesh, due)(plans)


@functools.partial(jax.jit, static_argnames=("mesh", "share"))
def _joined_locally(mesh: Mesh, parts: list[Any], share: int) -> tuple[Any, Array]:
    """One after another the parts of every device, which makes its share; as `solve_on_devices`."""

    def join(*parts: Any) -> tuple[Any, Array]:
        return counted(jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:share], *parts))

    return apart(mesh, join)(*parts)


@functools.partial(jax.jit, static_argnames="mesh")
def _merged_locally(mesh: Mesh, plans: Any, later: Any, lanes: Array) -> tuple[Any, Array]:
    """As on the host, of every device's share, and how many it then has unsolved."""

    def merge(plans: Any, later: Any, lanes: Array) -> tuple[Any, Array]:
        kept = better_of(_taken(plans, lanes), later, jnp.ones(lanes.shape, bool))

        def replace(old: Array, new: Array) -> Array:
            return old.at[lanes].set(new, mode="drop")

        return counted(jax.tree.map(replace, plans, kept))

    return apart(mesh, merge)(plans, later, lanes)
