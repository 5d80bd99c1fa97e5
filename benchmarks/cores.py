"""How much quicker a batch is planned on every core than on one, on this machine, now.

    python -m benchmarks.cores [--num 36000] [--turns 8]

Three kinds of processes stay alive and take turns, so that a slow minute of the machine meets
all of them: one process on one core; one on every core; and a process for each core, bound to
it, all at the same time. The last says how much the cores of this machine give at most: they
may share caches, memory or a clock. Printed are plans a second, warm, and the ratio to the one
core of the same turn. Linux, because processes are bound to cores.
"""

import argparse
import multiprocessing
import os
import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor


def _on(cores: Sequence[int]) -> ProcessPoolExecutor:
    """A process on some cores, to which it is bound before JAX starts its threads."""
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, spawn, initializer=os.sched_setaffinity, initargs=(0, cores))


def _planned(num: int) -> tuple[float, str]:
    """Seconds that planning hits took, warm, and how good the plans of the first call were."""
    if num not in _CASES:
        _CASES[num] = _first(num)
    planner, scenarios, quality = _CASES[num]
    from planner_jax.task.solve import plan

    began = time.perf_counter()
    plan(planner, scenarios)
    return time.perf_counter() - began, quality


_CASES: dict = {}  # of a process, by the number of hits


def _first(num: int) -> tuple:
    import numpy as np

    from planner_jax.referee.hit import referee_hits
    from planner_jax.task.hit.exact import ExactHit
    from planner_jax.task.hit.serves import generate_serves, to_scenarios
    from planner_jax.task.solve import plan

    planner, scenarios = ExactHit(), to_scenarios(generate_serves(num, 0))
    plans = plan(planner, scenarios)
    success = referee_hits(scenarios, plans).success.mean()
    quality = f"{100 * success:.2f} % refereed, median cost {np.median(plans.cost):.3g}"
    return planner, scenarios, quality


def main() -> None:
    """Take turns and print the rates."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num", type=int, default=36000, help="hits a process plans at a time")
    parser.add_argument("--turns", type=int, default=8)
    args = parser.parse_args()
    cores = sorted(os.sched_getaffinity(0))
    groups = {
        "one core": [_on(cores[-1:])],
        f"all {len(cores)} cores": [_on(cores)],
        "a process for each core": [_on([core]) for core in cores],
    }
    quality = {
        name: [child.submit(_planned, args.num).result()[1] for child in children][0]
        for name, children in groups.items()
    }
    rates: dict[str, list[float]] = {name: [] for name in groups}
    for _ in range(args.turns):
        for name, children in groups.items():
            begun = [child.submit(_planned, args.num) for child in children]
            rates[name].append(sum(args.num / one.result()[0] for one in begun))
    print(f"load average {os.getloadavg()[0]:.1f}; {args.turns} turns")
    print("| process | plans/s, median | lowest | highest | times one core | success |")
    print("|---|---|---|---|---|---|")
    alone = rates["one core"]
    for name, found in rates.items():
        times = statistics.median(f / a for f, a in zip(found, alone, strict=True))
        print(
            f"| {name} | {statistics.median(found):.0f} | {min(found):.0f} | {max(found):.0f} "
            f"| {times:.2f} | {quality[name]} |"
        )
    for children in groups.values():
        for child in children:
            child.shutdown()


if __name__ == "__main__":
    main()
