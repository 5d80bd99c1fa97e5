"""Plans a second of batches that stay on the devices: `planner-jax bench throughput`.

    planner-jax bench throughput --task hit --batch 1024 65536 288000 [--devices N]
    python -m benchmarks.throughput          both tasks, small

One row a batch size: the first call, with what it compiles; then, after half a second of calls
that bring up the device's clock, the fastest and the median of some more; the share that the
referee accepts; and by how much the cost is above that of a long search from the same guess. For
several devices also the efficiency beside one, and what each takes for its share alone. What
is timed is the whole of `plan` (for catches `plan_catches` with the decision "greedy"): ball
tables, guesses, all rounds, and the check of the limits, from arrays on the devices to arrays on
the devices, where each holds its share. The referee is not part of it.
"""

import dataclasses
import os
import resource
import statistics
import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.problem import Round
from planner_jax.protocol import is_solved
from planner_jax.referee.catch import referee_catches
from planner_jax.referee.hit import referee_hits
from planner_jax.sweep.settings import require
from planner_jax.sweep.timing import CompileClock
from planner_jax.task.catch.decide import plan_catches
from planner_jax.task.catch.exact import ExactCatch
from planner_jax.task.catch.suites import make_suite
from planner_jax.task.hit.exact import ExactHit
from planner_jax.task.hit.serves import generate_serves, to_scenarios
from planner_jax.task.solve import plan

_LONG = (Round(starts=1, solver=LbfgsConfig(max_steps=300, tolerance=1e-7, patience=6)),)
_WARM_UP = 0.5  # [s]
_JUDGED = 300_000  # lanes of a batch that the referee sees, at most
_COMPARED = 1024  # lanes whose cost is held against a long search's, and with the CPU's


class _Hits:
    """Generated serves and `ExactHit`."""

    planner = ExactHit()

    def scenarios(self, num: int, seed: int) -> Any:
        return to_scenarios(generate_serves(num, seed))

    def plan(self, planner: Any, scenarios: Any, devices: Any) -> tuple[Any, Any]:
        return scenarios, plan(planner, scenarios, devices=devices)

    def accepted(self, scenarios: Any, plans: Any) -> np.ndarray:
        return referee_hits(scenarios, plans).success

    def contact(self, plans: Any) -> Any:
        return plans.stroke.time


class _Catches:
    """The suite `throws` and `ExactCatch`."""

    planner = ExactCatch()

    def scenarios(self, num: int, seed: int) -> Any:
        return make_suite("throws", num=num, seed=seed)

    def plan(self, planner: Any, scenarios: Any, devices: Any) -> tuple[Any, Any]:
        return plan_catches(planner, scenarios, "greedy", devices=devices)

    def accepted(self, scenarios: Any, plans: Any) -> np.ndarray:
        return referee_catches(scenarios, plans).success

    def contact(self, plans: Any) -> Any:
        return plans.times[..., 0]


_TASKS: dict[str, Any] = {"hit": _Hits, "catch": _Catches}


def report(
    *,
    task: str,
    batch: Sequence[int],
    devices: int | None,
    iterations: int | None,
    repeat: int,
    seed: int,
    agree: bool,
) -> None:
    """Measure and print one row a batch size.

    Args:
        task: "hit" or "catch".
        batch: sizes.
        devices: how many share a batch; None for all.
        iterations: of the planner's first round; None for its own.
        repeat: timed calls.
        seed: of the scenarios.
        agree: whether the first lanes are compared with a CPU's.

    Raises:
        SettingError: there are fewer devices.
    """
    kind = _TASKS[task]()
    local = jax.local_devices()
    require(devices is None or devices <= len(local), "devices", f"<= {len(local)}", devices)
    used = local[: devices or len(local)]
    planner = kind.planner
    if iterations is not None:
        first, *rest = planner.rounds
        solver = dataclasses.replace(first.solver, max_steps=iterations)
        rounds = (dataclasses.replace(first, solver=solver), *rest)
        planner = dataclasses.replace(planner, rounds=rounds)
    print(
        f"{task}, {len(used)} x {used[0].device_kind}, jax {jax.__version__}, load average "
        f"{os.getloadavg()[0]:.1f}; first round: {planner.rounds[0].solver.max_steps} iterations"
    )
    print(
        "| plans | first call [s] | of it compiling [s] | fastest [ms] | median [ms] | plans/s |",
        end="",
    )
    print(" refereed | cost above a long search's (median, p90) | memory [GiB] |")
    print("|---|---|---|---|---|---|---|---|---|")
    beside = []
    for num in batch:
        host = jax.tree.map(np.asarray, kind.scenarios(num, seed))
        timed = _timed(kind, planner, host, used, repeat)
        print(_row(kind, planner, host, used, timed), flush=True)
        if num >= len(used) > 1:
            beside.append(_efficiency(kind, planner, host, used, repeat, timed))
    for line in beside:
        print(line)
    if agree:
        print(_agreement(kind, planner, seed, used))


@dataclasses.dataclass(frozen=True)
class _Timed:
    """Calls on one batch."""

    first: float  # [s]
    compiling: float  # [s], of the first
    seconds: list[float]  # of the others
    decided: Any  # the scenarios, with what was decided on before they were planned
    plans: Any

    @property
    def fastest(self) -> float:
        return min(self.seconds)


def _timed(kind: Any, planner: Any, host: Any, devices: list, repeat: int) -> _Timed:
    """Plan a batch that the devices hold in equal shares, once and then `repeat` times, warm."""
    num = jax.tree.leaves(host)[0].shape[0]
    shares = NamedSharding(Mesh(np.array(devices), "lanes"), PartitionSpec("lanes"))
    there = shares if len(devices) > 1 and num % len(devices) == 0 else devices[0]
    scenarios = jax.block_until_ready(jax.device_put(host, there))

    def call() -> tuple[float, Any]:
        began = time.perf_counter()
        found = jax.block_until_ready(kind.plan(planner, scenarios, devices))
        return time.perf_counter() - began, found

    with CompileClock() as clock:
        first, _ = call()
    began = time.perf_counter()
    while time.perf_counter() - began < _WARM_UP:
        call()
    seconds = []
    for _ in range(repeat):
        took, (decided, plans) = call()
        seconds.append(took)
    return _Timed(first, clock.seconds, seconds, decided, plans)


def _row(kind: Any, planner: Any, host: Any, devices: list, timed: _Timed) -> str:
    plans = jax.device_get(timed.plans)
    judged = jax.tree.map(lambda leaf: np.asarray(leaf)[:_JUDGED], (timed.decided, plans))
    accepted = kind.accepted(*judged)
    first = jax.tree.map(lambda leaf: leaf[:_COMPARED], (host, plans))
    _, best = kind.plan(dataclasses.replace(planner, rounds=_LONG), first[0], devices)
    both = is_solved(first[1].status) & is_solved(best.status)
    gap = 100.0 * (first[1].cost / best.cost - 1.0)[both]
    num, median = plans.status.size, statistics.median(timed.seconds)
    return (
        f"| {num:,} | {timed.first:.1f} | {timed.compiling:.1f} | {1e3 * timed.fastest:.2f} | "
        f"{1e3 * median:.2f} | {num / timed.fastest:,.0f} | {100.0 * accepted.mean():.3f} % "
        f"({(~accepted).sum()} of {accepted.size:,} fail) | {np.median(gap):.1f} %, "
        f"{np.quantile(gap, 0.9):.1f} % | {_memory(devices):.1f} |"
    )


def _efficiency(
    kind: Any, planner: Any, host: Any, devices: list, repeat: int, timed: _Timed
) -> str:
    """What several devices make of a batch beside one, and beside each of them alone."""
    num = timed.plans.status.size
    whole = _timed(kind, planner, host, devices[:1], repeat).fastest
    ends = np.linspace(0, num, len(devices) + 1).astype(int)
    alone = []
    for device, begin, end in zip(devices, ends[:-1], ends[1:], strict=True):
        share = jax.tree.map(lambda leaf: leaf[begin:end], host)  # noqa: B023
        alone.append(_timed(kind, planner, share, [device], repeat).fastest)
    shares = ", ".join(f"{1e3 * seconds:.2f}" for seconds in alone)
    return (
        f"{num:,} plans: one device takes {1e3 * whole:.2f} ms, so that {len(devices)} have an "
        f"efficiency of {whole / timed.fastest / len(devices):.3f}; each alone takes {shares} ms "
        f"for its share"
    )


def _memory(devices: list) -> float:
    """Peak of a device, or of the process on a CPU [GiB]."""
    stats = devices[0].memory_stats() or {}
    peak = stats.get("peak_bytes_in_use")
    if peak is None:
        peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**30


def _agreement(kind: Any, planner: Any, seed: int, devices: list) -> str:
    """How far plans of the devices differ from those of a CPU, lane by lane."""
    scenarios = jax.tree.map(np.asarray, kind.scenarios(_COMPARED, seed))
    _, ours = kind.plan(planner, scenarios, devices)
    with jax.default_device(jax.devices("cpu")[0]):
        _, theirs = kind.plan(planner, scenarios, jax.devices("cpu")[:1])
    same = np.asarray(ours.status) == np.asarray(theirs.status)
    later = np.abs(np.asarray(kind.contact(ours)) - np.asarray(kind.contact(theirs)))
    cost = np.abs(ours.cost / theirs.cost - 1.0)
    return (
        f"beside a CPU, {_COMPARED} lanes: status equal on {100.0 * same.mean():.2f} %; contact "
        f"time differs by {1e3 * np.quantile(later, 0.99):.3f} ms on 99 % and "
        f"{1e3 * later.max():.3f} at most; cost by {100.0 * np.quantile(cost, 0.99):.2g} % on 99 %"
    )


if __name__ == "__main__":
    for name in _TASKS:
        report(
            task=name,
            batch=(1024, 8192),
            devices=None,
            iterations=None,
            repeat=5,
            seed=0,
            agree=True,
        )
