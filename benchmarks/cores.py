"""How much quicker a batch is planned on every core than on one, on this machine, now.

    python -m benchmarks.cores [--num 36000] [--turns 8] [--out DIR]

Three kinds of processes stay alive and take turns, so that a slow minute of the machine meets
all of them: one process on one core; one on every core; and a process for each core, bound to
it, all at the same time. The last says how much the cores of this machine give at most: they
may share caches, memory or a clock. Printed are plans a second, warm, and the ratio to the one
core of the same turn. Linux, because processes are bound to cores.
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

# The processes import this module: what starts or measures nothing there is imported in `main`.


def _on(cores: Sequence[int]) -> ProcessPoolExecutor:
    """A process on some cores, to which it is bound before JAX starts its threads."""
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, spawn, initializer=os.sched_setaffinity, initargs=(0, cores))


@functools.cache
def _cases(num: int) -> tuple[Any, Any]:
    """A planner and hits for it."""
    return pj.hit.planner("exact"), pj.hit.draw(num)


def _first(num: int) -> Any:
    """The plans, with what had to be compiled for them."""
    return pj.plan(*_cases(num))


def _seconds(num: int) -> float:
    """How long planning takes, warm."""
    planner, cases = _cases(num)
    began = time.perf_counter()
    pj.plan(planner, cases)
    return time.perf_counter() - began


def main() -> None:
    """Take turns and print the rates."""
    from planner_jax.benchmarks.cost_gap import cost_gaps, gap_figures
    from planner_jax.benchmarks.run import argument_parser, begin

    parser = argument_parser("cores", __doc__, num=36000, turns=8)
    options = parser.parse_args()
    bench, num = begin(parser, options), options.num
    cores = sorted(os.sched_getaffinity(0))
    groups = {
        "one core": [_on(cores[-1:])],
        f"all {len(cores)} cores": [_on(cores)],
        "a process for each core": [_on([core]) for core in cores],
    }
    plans = {
        name: [child.submit(_first, num).result() for child in children][0]
        for name, children in groups.items()
    }
    rates: dict[str, list[float]] = {name: [] for name in groups}
    for _ in range(options.turns):
        for name, children in groups.items():
            begun = [child.submit(_seconds, num) for child in children]
            rates[name].append(sum(num / one.result() for one in begun))
    load = os.getloadavg()[0]
    for children in groups.values():
        for child in children:
            child.shutdown()
    with bench:  # from here on JAX runs in this process too
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
