"""Plan batches of cases in jax arrays, for `plan`; cases and plans stay on their device.

A lane is one case of a batch.
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
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
    Device,
    compiled,
    count_lanes,
    place,
    put_number,
    score_of,
    with_unsolved,
)


@dataclasses.dataclass(frozen=True)
class ResidentBatch(Batch):
    """A planner and the device that holds batches of cases, and their plans."""

    def plan(self, attempts: Sequence[BaseAttempt], cases: PyTree) -> tuple[PyTree, Array]:
        """Return plans of cases in jax arrays, and the number () of unsolved cases.

        Only this number is copied to the host.
        """
        planner, device, watch, num = self.planner, self.device, self.watch, count_lanes(cases)
        cases = place(cases, device)
        first, *others = attempts
        watch.report(planner, first, 0, num)
        plans, unsolved = self._first_plans(first, cases)
        unsolved.copy_to_host_async()  # the copy starts as soon as the number is computed
        for attempt in others:
            if not (attempt.improves or int(unsolved)):
                continue
            before, due = plans.status, unsolved
            if attempt.within is not None or attempt.improves:
                before, due = _mark_due(attempt, plans)
            num_due = int(due)
            if num_due == 0:
                continue
            if watch.is_over:
                plans = mark_out_of_time(plans, attempt.is_due(plans))
                break
            watch.report(planner, attempt, 0, num_due)
            for begin, size in self.sizes(attempt).cuts(num_due):
                known = cases, score_of(attempt, cases, plans)
                part, lanes = _cut_unsolved(size, known, before, put_number(device, begin))
                later, _ = self._solve(attempt, *part)
                plans, unsolved = _put_better(plans, later, lanes)
        return plans, unsolved

    def _first_plans(self, attempt: BaseAttempt, cases: PyTree) -> tuple[PyTree, Array]:
        device, sizes, num = self.device, self.sizes(attempt), count_lanes(cases)
        if num == sizes.next(num):
            return self._solve(attempt, cases, self._none(attempt, cases))
        cuts = list(sizes.cuts(num))

        def solve(begin: int, size: int) -> PyTree:
            part = _cut(size, cases, put_number(device, begin))
            return self._solve(attempt, part, self._none(attempt, part))[0]

        firsts = {size: begin for begin, size in reversed(cuts)}
        keys = {self._key(attempt, size, cases) for size in firsts}
        found: dict[int, PyTree] = {}
        if len(keys - compiled) > 1:  # compile several programs at the same time
            from planner_jax.host.threads import as_here, borrow_threads

            with borrow_threads(len(firsts)) as pool:
                plans = pool.map(as_here(solve), firsts.values(), firsts)
                found = dict(zip(firsts.values(), plans, strict=True))
            compiled.update(keys)
        parts = [found[begin] if begin in found else solve(begin, size) for begin, size in cuts]
        return _join(parts, num)

    def _none(self, attempt: BaseAttempt, cases: PyTree) -> Score | None:
        if not attempt.continues:
            return None
        return _place_none(self.device, count_lanes(cases), float_type(cases))


@functools.lru_cache(maxsize=64)
def _place_none(device: Device, num: int, dtype: np.dtype) -> Score:
    """Return the numbers of `num` cases without plans, on their device."""
    return place(jax.tree.map(jnp.asarray, Score.none((num,), dtype)), device)


@jax.jit
def take_lanes(tree: PyTree, lanes: Array) -> PyTree:
    """Return the cases at these indices; an index past the end selects the last case."""
    return jax.tree.map(lambda leaf: leaf[jnp.minimum(lanes, leaf.shape[0] - 1)], tree)


@functools.partial(jax.jit, static_argnames="size")
def _cut(size: int, tree: PyTree, begin: Array) -> PyTree:
    """Return the cases `begin` to `begin + size`, padded with the last case."""
    return take_lanes(tree, begin + jnp.arange(size))


@functools.partial(jax.jit, static_argnames="size")
def _cut_unsolved(
    size: int, tree: PyTree, status: Array, begin: Array
) -> tuple[tuple[PyTree, Score | None], Array]:
    (num,) = status.shape
    (unsolved,) = jnp.nonzero(is_unsolved(status), size=num, fill_value=num)
    lanes = take_lanes(unsolved, begin + jnp.arange(size))
    some, score = take_lanes(tree, lanes)
    return (some, score and score.without(lanes >= num)), lanes


@functools.partial(jax.jit, static_argnames="attempt")
def _mark_due(attempt: BaseAttempt, plans: PyTree) -> tuple[Array, Array]:
    """Return statuses that are unsolved where a search is due, and their number."""
    is_due = attempt.is_due(plans)
    status = jnp.where(is_due, Status.INFEASIBLE, Status.FEASIBLE).astype(jnp.int32)
    return status, jnp.sum(is_due)


@functools.partial(jax.jit, static_argnames="num")
def _join(parts: list[PyTree], num: int) -> tuple[PyTree, Array]:
    return with_unsolved(jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:num], *parts))


@jax.jit
def _put_better(plans: PyTree, later: PyTree, lanes: Array) -> tuple[PyTree, Array]:
    """Replace the plans at the indices `lanes` where the plans in `later` are better."""
    kept = select(later, take_lanes(plans, lanes))
    put = lambda old, new: old.at[lanes].set(new, mode="drop")  # noqa: E731
    return with_unsolved(jax.tree.map(put, plans, kept))
