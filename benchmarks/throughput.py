"""Measure plans per second for batches that stay on the devices: `planner-jax bench throughput`.

    planner-jax bench throughput --task hit --batch 1024 65536 288000 [--devices N] [--out DIR]
    python -m benchmarks.throughput [--tasks hit,catch] [--out DIR]

The table has one row for each batch size. It lists the first call with its compile time, the
fastest and the median of later calls, the share of plans that the referee (an independent check in
float64) accepts, and the relative cost above a longer search (`cost_gap`). Before later calls are
timed, calls run for half a second, so that the device reaches its highest clock frequency. For
several devices there is also the efficiency relative to one device, and the time that each device
alone takes for its part of the batch.

A time is for a whole call of `plan`, by any planner of any task, with the benchmark options of the
task specification. For example, catches use the greedy order: the target that can be caught first
comes first. The time includes tables of the balls' flights, initial guesses, all searches, and the
check of the limits, from arrays on the devices to arrays on the devices. Each device holds an equal
part of the batch. The referee is not part of the time.
"""

import dataclasses
import operator
import os
import resource
import statistics
import sys
import time
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from planner_jax.benchmarks.cost_gap import COMPARED, cost_gaps, gap_figures
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.benchmarks.throughput_settings import ThroughputSettings
from planner_jax.core.choices import require
from planner_jax.core.registry import Task
from planner_jax.core.tasks import all_tasks, task_named
from planner_jax.optimise.planner import SearchPlanner
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.planning.plan import plan
from planner_jax.runs.timing import CompileClock

_WARM_UP = 0.5  # [s] Time of calls before the measurement, in which the device's clock rises.
_JUDGED = 300_000  # Maximum number of plans of a batch that the referee judges.


def report(*, out: str | os.PathLike | None = None, **settings: Any) -> None:
    """Measure plans per second, print a row for each batch size, and write a run folder.

    Args:
        out: run folder, new or empty; None for a new folder in runs/.
        **settings: fields of `ThroughputSettings`, such as the task and the batch sizes.

    Raises:
        ArgumentError: the folder cannot be written, or a setting is invalid.
        UnknownName: there is no such task, planner or suite.
    """
    parsed, there = ThroughputSettings(**settings), len(jax.local_devices())
    require((parsed.devices or 1) <= there, "devices", f"<= {there}", parsed.devices)
    with Bench("throughput", dataclasses.asdict(parsed), out) as bench:
        measure(bench, parsed)


def measure(bench: Bench, settings: ThroughputSettings) -> None:
    """Measure plans per second, and print a row for each batch size.

    Raises:
        ArgumentError: a number of iterations is set for a planner that does not minimise a cost.
        UnknownName: there is no such task, planner or suite.
    """
    devices, iterations = settings.devices, settings.iterations
    suite, repeat = settings.suite, settings.repeat
    card, local = task_named(settings.task), jax.local_devices()
    used = local[: devices or len(local)]
    effort = {} if settings.effort is None else {"effort": settings.effort}
    made = card.planner(str(settings.planner), **card.bench, **effort)
    solver = made.planner if isinstance(made, DecidedPlanner) else made
    has_attempts = isinstance(solver, SearchPlanner)
    if iterations is not None:
        rule = "left out for a planner without attempts"
        require(has_attempts, "iterations", rule, iterations)
        made = _with_iterations(made, iterations)
    first = iterations or (solver.attempts[0].solver.max_steps if has_attempts else None)
    bench.say(
        f"{card.name}, {len(used)} x {used[0].device_kind}, jax {jax.__version__}, load average "
        f"{os.getloadavg()[0]:.1f}" + (f"; first attempt: {first} iterations" if first else ""),
        "| plans | first call [s] | its compilation [s] | fastest [ms] | median [ms] | plans/s | "
        "refereed | cost above a longer search (median, p90, p99) | memory [GiB] |",
        "|---|---|---|---|---|---|---|---|---|",
    )
    beside = []
    for num in settings.batch:
        _tell(f"Compiling the planner for {num:,} cases.")
        host = jax.tree.map(np.asarray, card.draw(num, suite, settings.seed))
        timed = _time_calls(made, host, used, repeat)
        _add_row(bench, card, made, host, used, timed)
        if num >= len(used) > 1:
            beside.append(_compare_devices(made, host, used, repeat, timed))
    if beside:
        bench.say(*beside)
    if settings.agree:
        bench.say(_compare_with_cpu(card, made, card.draw(COMPARED, suite, settings.seed), used))


def _with_iterations(planner: Any, iterations: int) -> Any:
    if isinstance(planner, DecidedPlanner):
        return dataclasses.replace(planner, planner=_with_iterations(planner.planner, iterations))
    first, *rest = planner.attempts
    solver = dataclasses.replace(first.solver, max_steps=iterations)
    return planner.with_settings(
        (("attempts", (dataclasses.replace(first, solver=solver), *rest)),)
    )


@dataclasses.dataclass(frozen=True)
class _Timed:
    """Durations of several calls that plan one batch, and the plans."""

    first: float  # [s], duration of the first call, with compilation
    compiling: float  # [s], compile time of the first call
    seconds: list[float]  # [s], durations of the later calls
    plans: Any  # plans of the last call

    @property
    def fastest(self) -> float:
        return min(self.seconds)


def _time_calls(planner: Any, host: Any, devices: list, repeat: int) -> _Timed:
    """Plan the batch `host` once, which compiles, and `repeat` times more; return durations.

    Each device holds an equal part of the batch.
    """
    num = jax.tree.leaves(host)[0].shape[0]
    shares = NamedSharding(Mesh(np.array(devices), "lanes"), PartitionSpec("lanes"))
    there = shares if len(devices) > 1 and num % len(devices) == 0 else devices[0]
    cases = jax.block_until_ready(jax.device_put(host, there))

    def call() -> tuple[float, Any]:
        began = time.perf_counter()
        plans = jax.block_until_ready(plan(planner, cases, devices=devices))
        return time.perf_counter() - began, plans

    with CompileClock() as clock:
        first, _ = call()
    began = time.perf_counter()
    while time.perf_counter() - began < _WARM_UP:
        call()
    seconds, plans = [], None
    for _ in range(repeat):
        del plans  # Plans of two calls at once would raise the measured peak of memory.
        took, plans = call()
        seconds.append(took)
    return _Timed(first, clock.seconds, seconds, plans)


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _add_row(
    bench: Bench, card: Task, planner: Any, host: Any, devices: list, timed: _Timed
) -> None:
    plans = jax.device_get(timed.plans)
    success = card.judge(*jax.tree.map(lambda leaf: leaf[:_JUDGED], (host, plans))).success
    speed = plans.status.size / timed.fastest
    _tell(f"{speed:,.0f} plans/s; the referee accepts {100.0 * success.mean():.3f} % of the plans.")
    _tell("Comparing costs with a longer search, if the task has one; it compiles first.")
    gaps = cost_gaps(planner, host, plans, devices, card=card)
    bench.count(success, gaps)
    figures = gap_figures(gaps)
    row = {
        "task": card.name,
        "num": plans.status.size,
        "first_seconds": timed.first,
        "compiling_seconds": timed.compiling,
        "fastest_seconds": timed.fastest,
        "median_seconds": statistics.median(timed.seconds),
        "plans_per_second": speed,
        "judged": success.size,
        "success": success.mean(),
        **figures,
        "memory_gib": _peak_memory(devices),
    }
    gap = ", ".join("-" if x is None else f"{100.0 * x:.1f} %" for x in figures.values())
    bench.say(
        f"| {row['num']:,} | {timed.first:.1f} | {timed.compiling:.1f} | "
        f"{1e3 * timed.fastest:.2f} | {1e3 * row['median_seconds']:.2f} | "
        f"{row['plans_per_second']:,.0f} | {100.0 * success.mean():.3f} % "
        f"({(~success).sum()} of {success.size:,} fail) | {gap} | {row['memory_gib']:.1f} |"
    )
    bench.row(**row)


def _compare_devices(planner: Any, host: Any, devices: list, repeat: int, timed: _Timed) -> str:
    """Compare the time of several devices with one device, and return the result as text.

    The text has the time of one device for the whole batch, the efficiency of all devices, and the
    time of each device alone for its part of the batch.
    """
    num = timed.plans.status.size
    whole = _time_calls(planner, host, devices[:1], repeat).fastest
    ends = np.linspace(0, num, len(devices) + 1).astype(int)
    alone = []
    for device, begins, ended in zip(devices, ends[:-1], ends[1:], strict=True):
        share = jax.tree.map(lambda leaf: leaf[begins:ended], host)  # noqa: B023
        alone.append(_time_calls(planner, share, [device], repeat).fastest)
    shares = ", ".join(f"{1e3 * seconds:.2f}" for seconds in alone)
    return (
        f"{num:,} plans: one device takes {1e3 * whole:.2f} ms, so {len(devices)} devices have an "
        f"efficiency of {whole / timed.fastest / len(devices):.3f}; each alone takes {shares} ms "
        f"for its share"
    )


def _peak_memory(devices: list) -> float:
    """Return the peak memory [GiB] of the first device, or of this process on a CPU."""
    stats = devices[0].memory_stats() or {}
    peak = stats.get("peak_bytes_in_use")
    if peak is None:
        peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**30


def _compare_with_cpu(card: Task, planner: Any, cases: Any, devices: list) -> str:
    cases = jax.tree.map(np.asarray, cases)
    ours = plan(planner, cases, devices=devices)
    with jax.default_device(jax.devices("cpu")[0]):
        theirs = plan(planner, cases, devices=jax.devices("cpu")[:1])
    same = np.asarray(ours.status) == np.asarray(theirs.status)
    text = f"compared with a CPU, {COMPARED} plans: status equal on {100.0 * same.mean():.2f} %"
    if card.contact:
        contact = operator.attrgetter(card.contact)
        later = np.abs(contact(ours) - contact(theirs))
        text += (
            f"; contact time differs by {1e3 * np.quantile(later, 0.99):.3f} ms on 99 % and "
            f"{1e3 * later.max():.3f} at most"
        )
    cost = np.abs(ours.cost - theirs.cost) / np.maximum(np.abs(theirs.cost), 1e-30)
    return f"{text}; cost by {100.0 * np.quantile(cost, 0.99):.2g} % on 99 %"


def main() -> None:
    parser = argument_parser("throughput", __doc__, seed=0)
    parser.add_argument(
        "--tasks", default="hit,catch", help="tasks, comma-separated (default: hit,catch)"
    )
    options = parser.parse_args()
    tasks = parse_names(parser, "--tasks", options.tasks, all_tasks())
    with begin(parser, options) as bench:
        for task in tasks:
            measure(bench, ThroughputSettings(task=task, seed=options.seed, agree=True))


if __name__ == "__main__":
    main()
