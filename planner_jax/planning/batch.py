"""Plan batches of cases on one device, for `plan`, in parts (chunks) of a few fixed sizes.

A lane is one case of a batch. The cases that an attempt (search) leaves unsolved are gathered into
a smaller batch for the next attempt. A `Watch` reports progress to the caller and ends the attempts
at the time limit.
"""

import dataclasses
import functools
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.planner import Planner
from planner_jax.core.protocol import (
    BaseAttempt,
    Score,
    is_resident,
    is_unsolved,
    mark_bad_input,
    mark_out_of_time,
    select_into,
)
from planner_jax.planning.programs import (
    FEW,
    Device,
    Sizes,
    compiled,
    count_lanes,
    is_cpu,
    place,
    program_key,
    score_of,
    sizes_of,
    solve_on_device,
)

if TYPE_CHECKING:
    from planner_jax.planning.plan import Watch

# One compiled call: the indices of its cases in the batch, padded to a fixed length with copies of
# the first index, and the number of cases without the padding.
_Call = tuple[np.ndarray, int]


def plan_batch(
    planner: Planner,
    attempts: Sequence[BaseAttempt],
    cases: PyTree,
    chunk: int | None,
    device: Device | None,
    watch: "Watch",
) -> tuple[PyTree, PyTree]:
    """Return plans of a batch, by attempts (searches), each made at the cases still unsolved.

    Args:
        planner: planner that makes the attempts.
        attempts: one or more attempts, in order.
        cases: batch of B cases, with a leading axis of length B on every leaf.
        chunk: number of cases that the device solves in one call; None: a number that suits it.
        device: device that plans the batch; None for the first local one.
        watch: ends the attempts at the time limit; the first attempt always starts.

    Returns:
        The plans, in NumPy arrays, or in jax arrays if all arrays of the cases are jax arrays;
        and the number of unsolved cases.
    """
    device = jax.local_devices()[0] if device is None else device
    if jax.tree.leaves(planner):
        planner = jax.device_put(planner, device)
    resident, num = is_resident(cases), count_lanes(cases)
    batch = Batch(planner, chunk, device, watch, is_cpu(device) and num <= FEW)
    # On a CPU, one thread for each core plans a part of the batch. NumPy divides the batch and
    # joins the plans, because JAX would compile a program for every new batch size.
    is_small = is_cpu(device) and num != batch.sizes(attempts[0]).next(num)
    if resident and not is_small:
        from planner_jax.planning.resident import ResidentBatch  # NumPy arrays do not need it

        return ResidentBatch(**vars(batch)).plan(attempts, cases)
    cases = jax.tree.map(np.asarray, cases)
    plans, unsolved = _try_in_turn(attempts, num, watch, functools.partial(batch.try_lanes, cases))
    return (jax.device_put(plans, device) if resident else plans), unsolved


def plan_on_host(
    planner: Planner, attempts: Sequence[BaseAttempt], cases: PyTree, watch: "Watch"
) -> tuple[PyTree, int]:
    """Return NumPy plans, and the number of unsolved ones, by a planner that runs on the host."""
    alone = cases.batch_shape == ()
    cases = jax.tree.map(lambda leaf: np.asarray(leaf)[None] if alone else np.asarray(leaf), cases)

    def try_lanes(attempt: BaseAttempt, lanes: np.ndarray, plans: PyTree) -> PyTree:
        watch.report(planner, attempt, 0, lanes.size)
        some = jax.tree.map(lambda leaf: leaf[lanes], cases)
        later = mark_bad_input(planner.solve_on_host(some, attempt), some)
        watch.report(planner, attempt, lanes.size, lanes.size)
        return jax.tree.map(np.array, later) if plans is None else select_into(plans, later, lanes)

    plans, unsolved = _try_in_turn(attempts, count_lanes(cases), watch, try_lanes)
    return jax.tree.map(lambda leaf: leaf[0], plans) if alone else plans, unsolved


def _try_in_turn(
    attempts: Sequence[BaseAttempt],
    num: int,
    watch: "Watch",
    try_lanes: Callable[[BaseAttempt, np.ndarray, PyTree], PyTree],
) -> tuple[PyTree, int]:
    """Return plans of `num` cases after all attempts (searches), and the number of unsolved plans.

    `try_lanes` makes one attempt at the cases with given indices. It takes the plans so far (None
    before the first attempt), and returns them with improvements at those indices.
    """
    first, *others = attempts
    plans = try_lanes(first, np.arange(num), None)
    for attempt in others:
        due = attempt.is_due(plans)
        lanes = np.flatnonzero(due)
        if not lanes.size:
            continue
        if watch.is_over:
            plans = mark_out_of_time(plans, due)
            break
        plans = try_lanes(attempt, lanes, plans)
    return plans, np.sum(is_unsolved(plans.status))


@dataclasses.dataclass(frozen=True)
class Batch:
    """A planner and the device on which it plans batches of cases."""

    planner: Planner
    chunk: int | None
    device: Device
    watch: "Watch"

    compiles_quickly: bool  # for a batch of few cases on a CPU

    def sizes(self, attempt: BaseAttempt) -> Sizes:
        """Return the numbers of cases that one compiled call of an attempt may solve."""
        return sizes_of(self.planner, attempt, self.chunk, self.device)

    def try_lanes(
        self, cases: PyTree, attempt: BaseAttempt, lanes: np.ndarray, plans: PyTree
    ) -> PyTree:
        """Return the plans after an attempt at the cases in NumPy arrays with indices `lanes`."""
        calls = self._calls(attempt, lanes)
        found, tried = [], 0
        self.watch.report(self.planner, attempt, 0, lanes.size)
        for one, (_, num) in zip(self._results(attempt, cases, calls, plans), calls, strict=True):
            found.append(one)
            if one is not None:
                tried += num
                self.watch.report(self.planner, attempt, tried, lanes.size)
        if plans is None:
            trimmed = [
                jax.tree.map(lambda leaf, n=num: np.asarray(leaf)[:n], part)
                for part, (_, num) in zip(found, calls, strict=True)
            ]
            return jax.tree.map(lambda *leaves: np.concatenate(leaves), *trimmed)
        untried = np.zeros(len(plans.status), bool)
        for (call, num), later in zip(calls, found, strict=True):
            if later is None:
                untried[call[:num]] = True
            else:
                plans = select_into(plans, later, call[:num])
        return mark_out_of_time(plans, untried) if untried.any() else plans

    def _calls(self, attempt: BaseAttempt, lanes: np.ndarray) -> list[_Call]:
        calls = []
        for first, size in self.sizes(attempt).cuts(lanes.size):
            part = lanes[first : first + size]
            filling = np.full(size - part.size, part[0])
            calls.append((np.append(part, filling), part.size))
        return calls

    def _results(
        self, attempt: BaseAttempt, cases: PyTree, calls: list[_Call], before: PyTree
    ) -> Iterator[PyTree]:
        """Yield the plans of each compiled call, or None after the time limit.

        `before` are the plans of earlier attempts. Without such plans the limit ends nothing.
        """
        watch = self.watch
        threads, lanes = 1, (cases, score_of(attempt, cases, before))
        if len(calls) > 1 and is_cpu(self.device):
            from planner_jax.host.machine import usable_cores  # small batches do not need it

            threads = min(len(calls), usable_cores() + 1)

        def solve(call: _Call) -> PyTree:
            if before is not None and watch.is_over:
                return None
            index, num = call
            some, score = jax.tree.map(lambda leaf: leaf[index], lanes)
            if score is not None:
                score = score.without(np.arange(index.size) >= num)
            found, _ = self._solve(attempt, *place((some, score), self.device))
            return jax.block_until_ready(found) if threads > 1 or watch.waits else found

        if threads == 1:  # JAX returns before a result is ready, so the next call is prepared early
            yield from map(solve, calls) if watch.waits else [solve(call) for call in calls]
            return
        from planner_jax.host.threads import as_here, borrow_threads

        # The first call runs alone, so that its program is compiled once and not in every thread.
        key = self._key(attempt, calls[0][0].size, cases)
        alone = [] if key in compiled else [solve(calls[0])]
        compiled.add(key)
        with borrow_threads(threads) as pool:
            later = pool.map(as_here(solve), calls[len(alone) :])
            yield from alone
            yield from later

    def _solve(
        self, attempt: BaseAttempt, cases: PyTree, before: Score | None
    ) -> tuple[PyTree, Array]:
        quickly = self.compiles_quickly
        return solve_on_device(
            self.planner, attempt, self.device, cases, before, compiles_quickly=quickly
        )

    def _key(self, attempt: BaseAttempt, num: int, cases: PyTree) -> Hashable:
        options = self.device, self.compiles_quickly
        return program_key(self.planner, attempt, num, cases, *options)
