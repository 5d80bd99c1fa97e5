"""Measure the speed-up of planning a batch on all cores over one core, on this machine.

    python -m benchmarks.cores [--num 36000] [--turns 8] [--out DIR]

Three groups of processes plan the same batch:
* one process on one core;
* one process on all cores;
* one process on each core, all at the same time. This group shows the greatest speed-up that the
  machine allows, which may be below the number of cores, because cores share caches and memory.

The groups take turns, so that other load on the machine affects all of them. For each group the
program prints plans per second without compilation, and their ratio to the plans per second on one
core in the same turn. It runs on Linux only, because it binds processes to cores.
"""

import functools
import multiprocessing
import os
import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

import planner_jax as pj

# Every child process imports this module. The function `main` contains the imports that only the
# main process needs, so that child processes start quickly.


def _start_process(cores: Sequence[int]) -> ProcessPoolExecutor:
    """Start a process, and bind it to the cores before JAX starts its threads."""
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, spawn, initializer=os.sched_setaffinity, initargs=(0, cores))


@functools.cache
def _cases(num: int) -> tuple[Any, Any]:
    """Return the planner `exact` and a batch of `num` drawn hits; repeated calls reuse them."""
    return pj.hit.planner("exact"), pj.hit.draw(num)


def _plan_first(num: int) -> Any:
    """Plan `num` hits for the first time, which compiles the programs; return the plans."""
    return pj.plan(*_cases(num))


def _time_plan(num: int) -> float:
    """Plan `num` hits with compiled programs; return the duration [s]."""
    planner, cases = _cases(num)
    began = time.perf_counter()
    pj.plan(planner, cases)
    return time.perf_counter() - began


def main() -> None:
    from planner_jax.benchmarks.cost_gap import cost_gaps, gap_figures
    from planner_jax.benchmarks.run import argument_parser, begin

    parser = argument_parser("cores", __doc__, num=36000, turns=8)
    options = parser.parse_args()
    bench, num = begin(parser, options), options.num
    cores = sorted(os.sched_getaffinity(0))
    groups = {
        "one core": [_start_process(cores[-1:])],
        f"all {len(cores)} cores": [_start_process(cores)],
        "a process for each core": [_start_process([core]) for core in cores],
    }
    plans = {
        name: [child.submit(_plan_first, num).result() for child in children][0]
        for name, children in groups.items()
    }
    rates: dict[str, list[float]] = {name: [] for name in groups}
    for _ in range(options.turns):
        for name, children in groups.items():
            running = [child.submit(_time_plan, num) for child in children]
            rates[name].append(sum(num / one.result() for one in running))
    load = os.getloadavg()[0]
    for children in groups.values():
        for child in children:
            child.shutdown()
    with bench:  # JAX starts in this process only after the measurement, so it took no core.
        bench.say(
            f"load average {load:.1f}; {options.turns} turns",
            "| process | plans/s, median | lowest | highest | times one core | success |",
            "|---|---|---|---|---|---|",
        )
        planner, cases = _cases(num)
        for name, found in rates.items():
            pairs = zip(found, rates["one core"], strict=True)
            times, median = statistics.median(f / a for f, a in pairs), statistics.median(found)
            success = pj.hit.judge(cases, plans[name]).success
            gaps = cost_gaps(planner, cases, plans[name])
            bench.count(success, gaps)
            bench.say(
                f"| {name} | {median:.0f} | {min(found):.0f} | {max(found):.0f} | {times:.2f} "
                f"| {100 * success.mean():.2f} % refereed, median cost "
                f"{np.median(plans[name].cost):.3g} |"
            )
            bench.row(
                process=name,
                plans_per_second=median,
                lowest=min(found),
                highest=max(found),
                times_one_core=times,
                success=success.mean(),
                **gap_figures(gaps),
            )


if __name__ == "__main__":
    main()
