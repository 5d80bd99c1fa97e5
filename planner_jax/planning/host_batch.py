"""Batches in NumPy arrays: chunks go to the devices and their plans come back."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt, is_unsolved, marked, out_of_time
from planner_jax.host.processors import usable_cores
from planner_jax.host.threads import as_here
from planner_jax.planning.layout import calls_of, is_one_cpu, length, sharding, sizes_of
from planner_jax.planning.programs import COMPILED, program_of, solve_on_devices
from planner_jax.planning.progress import Watch
from planner_jax.planning.select import merged


def plan_on_host(
    planner: Planner, attempts: Sequence[Attempt], cases: Any, watch: Watch
) -> tuple[Any, int]:
    """As `plan_batch`, by a planner that works on the host; NumPy leaves. One case will do, too."""
    alone = cases.batch_shape == ()
    cases = jax.tree.map(lambda leaf: np.asarray(leaf)[None] if alone else np.asarray(leaf), cases)

    def after(attempt: Attempt, lanes: np.ndarray, plans: Any) -> Any:
        watch.tell(planner, attempt, 0, lanes.size)
        some = jax.tree.map(lambda leaf: leaf[lanes], cases)
        later = marked(planner.solve_on_host(some, attempt), some)
        watch.tell(planner, attempt, lanes.size, lanes.size)
        return jax.tree.map(np.array, later) if plans is None else merged(plans, later, lanes)

    plans, unsolved = _in_turn(attempts, length(cases), watch, after)
    return jax.tree.map(lambda leaf: leaf[0], plans) if alone else plans, unsolved


def plan_from_host(
    planner: Any,
    attempts: Sequence[Attempt],
    cases: Any,
    chunk: int | None,
    mesh: Mesh,
    watch: Watch,
) -> tuple[Any, int]:
    """As `plan_batch`, of cases in NumPy arrays."""
    cases = jax.tree.map(np.asarray, cases)

    def after(attempt: Attempt, lanes: np.ndarray, plans: Any) -> Any:
        calls = calls_of(lanes, sizes_of(planner, attempt, chunk, mesh), mesh)
        may_end = plans is not None
        each = _each_from_host(planner, attempt, cases, calls, mesh, watch, may_end)
        found = _told(planner, attempt, calls, watch, each)
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
                plans = merged(plans, later, call[:num])
        return out_of_time(plans, untried) if untried.any() else plans

    return _in_turn(attempts, length(cases), watch, after)


def _in_turn(
    attempts: Sequence[Attempt],
    num: int,
    watch: Watch,
    after: Callable[[Attempt, np.ndarray, Any], Any],
) -> tuple[Any, int]:
    """Plans (num, ...) by one attempt after another, and how many are unsolved.

    Args:
        attempts: in order, the first at all lanes.
        num: of lanes.
        watch: after whose end no attempt but the first is begun.
        after: makes of the plans so far, None at first, those after an attempt at some lanes.
    """
    first, *others = attempts
    plans = after(first, np.arange(num), None)
    for attempt in others:
        due = attempt.is_due(plans)
        lanes = np.flatnonzero(due)
        if not lanes.size:
            continue
        if watch.is_over:
            plans = out_of_time(plans, due)
            break
        plans = after(attempt, lanes, plans)
    return plans, np.sum(is_unsolved(plans.status))


def _told(
    planner: Any,
    attempt: Attempt,
    calls: list[tuple[np.ndarray, int]],
    watch: Watch,
    each: Iterator[Any],
) -> list[Any]:
    """What each call found, of which the watch is told as it comes."""
    found, tried, cases_left = [], 0, sum(num for _, num in calls)
    watch.tell(planner, attempt, tried, cases_left)
    for one, (_, num) in zip(each, calls, strict=True):
        found.append(one)
        if one is not None:
            tried += num
            watch.tell(planner, attempt, tried, cases_left)
    return found


def _each_from_host(
    planner: Any,
    attempt: Attempt,
    cases: Any,
    calls: list[tuple[np.ndarray, int]],
    mesh: Mesh,
    watch: Watch,
    may_end: bool,
) -> Iterator[Any]:
    """One attempt at the lanes of every call; on one CPU device with a thread for each core.

    One thread more hands over the next call while the others compute. Where the attempt may end
    early, there is None for the calls that were not begun in time.
    """
    threads = min(len(calls), usable_cores() + 1) if is_one_cpu(mesh) else 1
    placed = sharding(mesh)

    def solve(call: tuple[np.ndarray, int]) -> Any:
        if may_end and watch.is_over:
            return None
        lanes, _ = call
        part = jax.device_put(jax.tree.map(lambda leaf: leaf[lanes], cases), placed)
        found, _ = solve_on_devices(planner, attempt, mesh, part)
        return jax.block_until_ready(found) if threads > 1 or watch.waits else found

    if threads == 1:  # calls return before they are done, so that the next is under way
        yield from map(solve, calls) if watch.waits else [solve(call) for call in calls]
        return
    # A first call compiles, once for all threads; what is compiled is found by all.
    program = program_of(planner, attempt, calls[0][0].size, cases)
    alone = [] if program in COMPILED else [solve(calls[0])]
    COMPILED.add(program)
    with ThreadPoolExecutor(threads) as pool:
        later = pool.map(as_here(solve), calls[len(alone) :])
        yield from alone
        yield from later
