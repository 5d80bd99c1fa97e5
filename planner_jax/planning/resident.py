"""Plan batches of cases in jax arrays, for `plan`; cases and plans stay on their devices.

A lane is one case of a batch. Each device gathers the cases that it leaves unsolved by itself.
"""

import dataclasses
import functools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import PyTree

from planner_jax.core.arithmetic import float_type
from planner_jax.core.protocol import (
    BaseAttempt,
    Score,
    Status,
    is_unsolved,
    mark_out_of_time,
    select,
)
from planner_jax.planning.batch import Batch
from planner_jax.planning.programs import (
    LANES,
    compiled,
    count_lanes,
    place_lanes,
    put_number,
    run_per_device,
    score_of,
    with_unsolved,
)


@dataclasses.dataclass(frozen=True)
class ResidentBatch(Batch):
    """A planner and the devices that hold batches of cases, and their plans."""

    def plan(self, attempts: Sequence[BaseAttempt], cases: PyTree) -> tuple[PyTree, Array]:
        """Return plans of cases in jax arrays, and the number of unsolved cases of each device.

        Only these numbers are copied to the host.
        """
        planner, mesh, watch, num = self.planner, self.mesh, self.watch, count_lanes(cases)
        if num % mesh.size:  # repeat the last case until all devices have equally many cases
            cases = _take(cases, np.arange(-(-num // mesh.size) * mesh.size))
        cases = place_lanes(cases, mesh)
        first, *others = attempts
        watch.report(planner, first, 0, num)
        plans, unsolved = self._first_plans(first, cases)
        unsolved.copy_to_host_async()  # the copy starts as soon as the number is computed
        for attempt in others:
            if not (attempt.improves or np.asarray(unsolved).any()):
                continue
            before, due = plans.status, unsolved
            if attempt.within is not None or attempt.improves:
                before, due = _mark_due(mesh, attempt, plans)
            most = np.asarray(due).max()  # greatest number of due cases on one device
            if most == 0:
                continue
            if watch.is_over:
                plans = mark_out_of_time(plans, attempt.is_due(plans))
                break
            watch.report(planner, attempt, 0, np.asarray(due).sum())
            for begin, size in self.sizes(attempt).cuts(most):
                known = cases, score_of(attempt, cases, plans)
                part, lanes = _cut_unsolved(mesh, size, known, before, put_number(mesh, begin))
                later, _ = self._solve(attempt, *part)
                plans, unsolved = _select_locally(mesh, plans, later, lanes)
        if num % mesh.size:  # JAX cannot shard an axis into unequal parts
            plans = _take(jax.device_put(plans, mesh.devices[0]), np.arange(num))
        return plans, unsolved

    def _first_plans(self, attempt: BaseAttempt, cases: PyTree) -> tuple[PyTree, Array]:
        mesh, sizes, share = self.mesh, self.sizes(attempt), count_lanes(cases) // self.mesh.size
        if share == sizes.next(share):
            return self._solve(attempt, cases, self._none(attempt, cases))
        cuts = list(sizes.cuts(share))

        def solve(begin: int, size: int) -> PyTree:
            part = _cut(mesh, size, cases, put_number(mesh, begin))
            return self._solve(attempt, part, self._none(attempt, part))[0]

        firsts = {size: begin for begin, size in reversed(cuts)}
        keys = {self._key(attempt, size, cases) for size in firsts}
        found: dict[int, PyTree] = {}
        if len(keys - compiled) > 1:  # compile several programs at the same time
            from planner_jax.host.machine import as_here  # small batches do not need it

            with ThreadPoolExecutor(len(firsts)) as pool:
                plans = pool.map(as_here(solve), firsts.values(), firsts)
                found = dict(zip(firsts.values(), plans, strict=True))
            compiled.update(keys)
        parts = [found[begin] if begin in found else solve(begin, size) for begin, size in cuts]
        return _join_locally(mesh, parts, share)

    def _none(self, attempt: BaseAttempt, cases: PyTree) -> Score | None:
        if not attempt.continues:
            return None
        return _place_none(self.mesh, count_lanes(cases), float_type(cases))


@functools.lru_cache(maxsize=64)
def _place_none(mesh: Mesh, num: int, dtype: np.dtype) -> Score:
    """Return the numbers of `num` cases without plans, on their devices."""
    return place_lanes(jax.tree.map(jnp.asarray, Score.none((num,), dtype)), mesh)


@jax.jit
def _take(tree: PyTree, lanes: PyTree) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[jnp.minimum(lanes, leaf.shape[0] - 1)], tree)


@functools.partial(jax.jit, static_argnames=("mesh", "size"))
def _cut(mesh: Mesh, size: int, tree: PyTree, begin: PyTree) -> PyTree:
    """Return cases `begin` to `begin + size` of each device, padded with the device's last case."""

    def cut(tree: PyTree, begin: Array) -> PyTree:
        return _take(tree, begin + jnp.arange(size))

    return run_per_device(mesh, cut, LANES, PartitionSpec())(tree, begin)


@functools.partial(jax.jit, static_argnames=("mesh", "size"))
def _cut_unsolved(
    mesh: Mesh, size: int, tree: PyTree, status: Array, begin: PyTree
) -> tuple[PyTree, Array]:

    def cut(tree: PyTree, status: Array, begin: Array) -> tuple[PyTree, Array]:
        (num,) = status.shape
        (unsolved,) = jnp.nonzero(is_unsolved(status), size=num, fill_value=num)
        lanes = _take(unsolved, begin + jnp.arange(size))
        some, score = _take(tree, lanes)
        return (some, score and score.without(lanes >= num)), lanes

    return run_per_device(mesh, cut, LANES, LANES, PartitionSpec())(tree, status, begin)


@functools.partial(jax.jit, static_argnames=("mesh", "attempt"))
def _mark_due(mesh: Mesh, attempt: BaseAttempt, plans: PyTree) -> tuple[Array, Array]:
    """Return statuses that are unsolved where a search is due, and their number."""

    def due(plans: PyTree) -> tuple[Array, Array]:
        is_due = attempt.is_due(plans)
        status = jnp.where(is_due, Status.INFEASIBLE, Status.FEASIBLE).astype(jnp.int32)
        return status, jnp.sum(is_due, keepdims=True)

    return run_per_device(mesh, due)(plans)


@functools.partial(jax.jit, static_argnames=("mesh", "share"))
def _join_locally(mesh: Mesh, parts: list[PyTree], share: int) -> tuple[PyTree, Array]:

    def join(*parts: PyTree) -> tuple[PyTree, Array]:
        return with_unsolved(jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:share], *parts))

    return run_per_device(mesh, join)(*parts)


@functools.partial(jax.jit, static_argnames="mesh")
def _select_locally(mesh: Mesh, plans: PyTree, later: PyTree, lanes: Array) -> tuple[PyTree, Array]:

    def merge(plans: PyTree, later: PyTree, lanes: Array) -> tuple[PyTree, Array]:
        kept = select(later, _take(plans, lanes))

        def replace(old: Array, new: Array) -> Array:
            return old.at[lanes].set(new, mode="drop")

        return with_unsolved(jax.tree.map(replace, plans, kept))

    return run_per_device(mesh, merge)(plans, later, lanes)
