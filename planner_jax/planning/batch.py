"""Plan batches of cases, for `plan`, in parts (chunks) of a few fixed sizes on all devices.

A lane is one case of a batch. The cases that an attempt (search) leaves unsolved are gathered into
a smaller batch for the next attempt. Each device solves its lanes in its own loop and waits for no
other device. A `Watch` reports progress to the caller and ends the attempts at the time limit.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import PyTree

from planner_jax.core.checks import require_scalar
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import (
    Attempt,
    Status,
    is_resident,
    is_unsolved,
    mark_bad_input,
    mark_out_of_time,
    select,
    select_into,
)
from planner_jax.planning.programs import (
    FEW,
    LANES,
    Sizes,
    compiled,
    count_lanes,
    is_one_cpu,
    lane_sharding,
    on_devices,
    place_lanes,
    program_key,
    put_number,
    run_per_device,
    sizes_of,
    solve_on_devices,
    with_unsolved,
)

_QUIET = 1.0  # [s] least time between two progress reports of one round


@dataclasses.dataclass(frozen=True)
class Progress:
    """Report of `plan` on the progress of an attempt (search); `str` formats it as one line."""

    round: int  # number of this round, counted from 1
    rounds: int  # greatest number of rounds that the planner makes
    tried: int  # number of cases that this round has tried so far
    cases: int  # number of cases of this round: all that earlier rounds left unsolved
    seconds: float  # [s] time since the start of planning

    def __str__(self) -> str:
        return (
            f"round {self.round} of at most {self.rounds}: {self.tried:,} of {self.cases:,} cases "
            f"tried, after {self.seconds:.1f} s"
        )


class Watch:
    """The clock of one call of `plan`: it reports progress and knows when the time limit passes.

    Args:
        time_limit: [s] time after the construction from which no search starts; None: no limit.
        progress: function that receives a `Progress` for each report; None: no reports.

    Raises:
        TypeError: the time limit is not a number, or `progress` is not callable.
        ValueError: the time limit is negative or NaN.
    """

    def __init__(
        self, time_limit: float | None = None, progress: Callable[[Progress], object] | None = None
    ) -> None:
        if time_limit is not None:
            if not require_scalar("time_limit", time_limit) >= 0.0:
                raise ArgumentError("time_limit", ">= 0 s", time_limit)
        if progress is not None and not callable(progress):
            raise ArgumentTypeError("progress", "callable, such as print", progress)
        self._start, self._limit, self._progress = time.monotonic(), time_limit, progress
        self._reported = (0, 0.0)  # number of the attempt, and time [s], of the last report

    @property
    def waits(self) -> bool:
        """Return whether the host waits for each call, as a time limit or progress reports need."""
        return self._limit is not None or self._progress is not None

    @property
    def is_over(self) -> bool:
        """True if the time limit has passed."""
        return self._limit is not None and time.monotonic() - self._start >= self._limit

    def report(self, planner: Planner, attempt: Attempt, tried: int, cases: int) -> None:
        """Report progress at the start and end of a search, and else at most once a second."""
        if self._progress is None:
            return
        seconds, rounds = time.monotonic() - self._start, tuple(planner.attempts)
        place = rounds.index(attempt) + 1 if attempt in rounds else 1
        last_place, last = self._reported
        if 0 < tried < cases and place == last_place and seconds - last < _QUIET:
            return
        self._reported = place, seconds
        self._progress(Progress(place, max(len(rounds), place), int(tried), int(cases), seconds))


# One compiled call: the indices of its cases in the batch, padded to a fixed length with copies of
# the first index, and the number of cases without the padding.
_Call = tuple[np.ndarray, int]


def plan_batch(
    planner: Planner,
    attempts: Sequence[Attempt],
    cases: PyTree,
    chunk: int | None,
    devices: Sequence[jax.Device] | None,  # pyright: ignore[reportInvalidTypeForm]
    watch: Watch,
) -> tuple[PyTree, PyTree]:
    """Return plans of a batch, by attempts (searches), each made at the cases still unsolved.

    Args:
        planner: planner that makes the attempts.
        attempts: one or more attempts, in order.
        cases: batch of B cases, with a leading axis of length B on every leaf.
        chunk: number of cases that a device solves in one call; None: a number that suits it.
        devices: devices that share the batch; None for all local devices.
        watch: ends the attempts at the time limit; the first attempt always starts.

    Returns:
        The plans, in NumPy arrays, or in jax arrays if all arrays of the cases are jax arrays;
        and the number of unsolved cases, or an array with one such number for each device.
    """
    planner, mesh = on_devices(planner, devices)
    resident, num = is_resident(cases), count_lanes(cases)
    batch = _Batch(planner, chunk, mesh, watch, is_one_cpu(mesh) and num <= FEW)
    # On one CPU, one thread for each core plans a part of the batch. NumPy divides the batch and
    # joins the plans, because JAX would compile a program for every new batch size.
    is_small = is_one_cpu(mesh) and num != batch.sizes(attempts[0]).next(num)
    if resident and not is_small and not planner.divides(attempts[0]):
        return batch.plan_resident(attempts, cases)
    cases = jax.tree.map(np.asarray, cases)
    plans, unsolved = _try_in_turn(attempts, num, watch, functools.partial(batch.try_lanes, cases))
    return (jax.device_put(plans, lane_sharding(mesh)) if resident else plans), unsolved


def plan_on_host(
    planner: Planner, attempts: Sequence[Attempt], cases: PyTree, watch: Watch
) -> tuple[PyTree, int]:
    """Return NumPy plans, and the number of unsolved ones, by a planner that runs on the host."""
    alone = cases.batch_shape == ()
    cases = jax.tree.map(lambda leaf: np.asarray(leaf)[None] if alone else np.asarray(leaf), cases)

    def try_lanes(attempt: Attempt, lanes: np.ndarray, plans: PyTree) -> PyTree:
        watch.report(planner, attempt, 0, lanes.size)
        some = jax.tree.map(lambda leaf: leaf[lanes], cases)
        later = mark_bad_input(planner.solve_on_host(some, attempt), some)
        watch.report(planner, attempt, lanes.size, lanes.size)
        return jax.tree.map(np.array, later) if plans is None else select_into(plans, later, lanes)

    plans, unsolved = _try_in_turn(attempts, count_lanes(cases), watch, try_lanes)
    return jax.tree.map(lambda leaf: leaf[0], plans) if alone else plans, unsolved


def _try_in_turn(
    attempts: Sequence[Attempt],
    num: int,
    watch: Watch,
    try_lanes: Callable[[Attempt, np.ndarray, PyTree], PyTree],
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
class _Batch:
    planner: Planner
    chunk: int | None
    mesh: Mesh
    watch: Watch

    compiles_quickly: bool  # for a batch of few cases on a CPU

    def sizes(self, attempt: Attempt) -> Sizes:
        return sizes_of(self.planner, attempt, self.chunk, self.mesh)

    def try_lanes(
        self, cases: PyTree, attempt: Attempt, lanes: np.ndarray, plans: PyTree
    ) -> PyTree:
        calls = self._calls(attempt, lanes)
        found, tried = [], 0
        self.watch.report(self.planner, attempt, 0, lanes.size)
        for one, (_, num) in zip(
            self._results(attempt, cases, calls, plans is not None), calls, strict=True
        ):
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

    def _calls(self, attempt: Attempt, lanes: np.ndarray) -> list[_Call]:
        calls, devices = [], self.mesh.size
        for first, size in self.sizes(attempt).cuts(-(-lanes.size // devices)):
            part = lanes[first * devices :][: size * devices]
            filling = np.full(size * devices - part.size, part[0])
            calls.append((np.append(part, filling), part.size))
        return calls

    def _results(
        self, attempt: Attempt, cases: PyTree, calls: list[_Call], may_end: bool
    ) -> Iterator[PyTree]:
        """Yield the plans of each compiled call, or None after the time limit if `may_end`."""
        watch, spec = self.watch, lane_sharding(self.mesh)
        threads = 1
        if len(calls) > 1 and is_one_cpu(self.mesh):
            from planner_jax.host.machine import usable_cores  # small batches do not need it

            threads = min(len(calls), usable_cores() + 1)

        def solve(call: _Call) -> PyTree:
            if may_end and watch.is_over:
                return None
            if self.planner.divides(attempt):
                lanes, num = call
                return self._divide(attempt, jax.tree.map(lambda leaf: leaf[lanes[:num]], cases))
            part = jax.device_put(jax.tree.map(lambda leaf: leaf[call[0]], cases), spec)
            found, _ = self._solve(attempt, part)
            return jax.block_until_ready(found) if threads > 1 or watch.waits else found

        if threads == 1:  # JAX returns before a result is ready, so the next call is prepared early
            yield from map(solve, calls) if watch.waits else [solve(call) for call in calls]
            return
        from planner_jax.host.machine import as_here

        # The first call runs alone, so that its program is compiled once and not in every thread.
        key = self._key(attempt, calls[0][0].size, cases)
        alone = [] if key in compiled else [solve(calls[0])]
        compiled.add(key)
        with ThreadPoolExecutor(threads) as pool:
            later = pool.map(as_here(solve), calls[len(alone) :])
            yield from alone
            yield from later

    def _solve(self, attempt: Attempt, cases: PyTree) -> tuple[PyTree, Array]:
        return solve_on_devices(
            self.planner, attempt, self.mesh, cases, compiles_quickly=self.compiles_quickly
        )

    def _key(self, attempt: Attempt, num: int, cases: PyTree) -> Hashable:
        return program_key(self.planner, attempt, num, cases, self.compiles_quickly)

    def _divide(self, attempt: Attempt, cases: PyTree) -> PyTree:
        from planner_jax.planning.searches import divide_batch  # few cases need it

        return divide_batch(self.planner, attempt, self.mesh, cases)

    def _divide_resident(self, attempt: Attempt, cases: PyTree, is_case: np.ndarray) -> PyTree:
        found = self._divide(attempt, jax.tree.map(lambda leaf: np.asarray(leaf)[is_case], cases))
        row = np.maximum(np.cumsum(is_case) - 1, 0)  # repeats a plan for the padding
        found = jax.tree.map(lambda leaf: leaf[row], found)
        return jax.device_put(found, lane_sharding(self.mesh))

    def plan_resident(self, attempts: Sequence[Attempt], cases: PyTree) -> tuple[PyTree, Array]:
        """Return plans of cases in jax arrays, and the number of unsolved cases of each device.

        Only these numbers are copied to the host.
        """
        planner, mesh, watch, num = self.planner, self.mesh, self.watch, count_lanes(cases)
        if num % mesh.size:  # repeat the last case until all devices have equally many cases
            cases = _take(cases, np.arange(-(-num // mesh.size) * mesh.size))
        cases = place_lanes(cases, mesh)
        first, *others = attempts
        share = count_lanes(cases) // mesh.size
        watch.report(planner, first, 0, num)
        plans, unsolved = self._first_plans(first, cases)
        for attempt in others:
            before, due = plans.status, unsolved
            if attempt.within is not None or attempt.improves:
                before, due = _mark_due(mesh, attempt, plans)
            due.copy_to_host_async()  # the copy starts as soon as the number is computed
            most = np.asarray(due).max()  # greatest number of due cases on one device
            if most == 0:
                continue
            if watch.is_over:
                plans = mark_out_of_time(plans, attempt.is_due(plans))
                break
            watch.report(planner, attempt, 0, np.asarray(due).sum())
            for begin, size in self.sizes(attempt).cuts(most):
                part, lanes = _cut_unsolved(mesh, size, cases, before, put_number(mesh, begin))
                if planner.divides(attempt):
                    later = self._divide_resident(attempt, part, np.asarray(lanes) < share)
                else:
                    later, _ = self._solve(attempt, part)
                plans, unsolved = _select_locally(mesh, plans, later, lanes)
        if num % mesh.size:  # JAX cannot shard an axis into unequal parts
            plans = _take(jax.device_put(plans, mesh.devices[0]), np.arange(num))
        return plans, unsolved

    def _first_plans(self, attempt: Attempt, cases: PyTree) -> tuple[PyTree, Array]:
        mesh, sizes, share = self.mesh, self.sizes(attempt), count_lanes(cases) // self.mesh.size
        if share == sizes.next(share):
            return self._solve(attempt, cases)
        cuts = list(sizes.cuts(share))

        def solve(begin: int, size: int) -> PyTree:
            part = _cut(mesh, size, cases, put_number(mesh, begin))
            return self._solve(attempt, part)[0]

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
        return _take(tree, lanes), lanes

    return run_per_device(mesh, cut, LANES, LANES, PartitionSpec())(tree, status, begin)


@functools.partial(jax.jit, static_argnames=("mesh", "attempt"))
def _mark_due(mesh: Mesh, attempt: Attempt, plans: PyTree) -> tuple[Array, Array]:
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
