"""Measure how often planners solve a case within the computing time that the papers report.

    taskset -c 1 python -m benchmarks.real_time [--task catch] [--planner NAME] [--suite NAME]
        [--budget-ms 10] [--num 200] [--seed 1] [--out DIR]

Each case is planned alone, on one core if the command is bound to one. A case is in time if its own
wall time, from the case's arrays to the plan's arrays without compilation, is at most the budget.
It counts as a success if the referee, an independent check in float64, also accepts its plan.

Without options, the default planner and the published planners of four tasks are measured. The
budgets are the times that the papers report: 20 ms for all modules of a hit [Yu2023bat], 10 ms for
a catch, which takes 9 ms in [Yu2023catch], and 154 ms for an interception [Qu2022]. The budget of
2 s for a block is ours; [Natarajan2024] instead starts the motion after the computing time.
"""

import os
import sys
from typing import Any

import jax
import numpy as np

from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.core.tasks import task_named
from planner_jax.host.machine import processor, usable_cores
from planner_jax.runs.timing import measure_plans

# Task -> suite, planners, and greatest computing time [ms].
TASKS: dict[str, tuple[str, tuple[str, ...], float]] = {
    "hit": ("court", ("exact", "bat", "bat-lite", "juggle"), 20.0),
    "catch": ("throws", ("exact", "catch", "mpp"), 10.0),
    "intercept": ("hard", ("spacetime", "paper"), 154.0),
    "block": ("pole", ("online", "insat"), 2000.0),
}


def measure(
    planner: Any, judge: Any, cases: Any, budget: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Plan cases one at a time; return success, whether each is in time, and times [ms], all (B,).

    `judge(cases, plans)` returns a verdict, and `budget` [ms] is the greatest computing time.
    """
    plans, seconds = measure_plans(planner, cases)
    times = 1e3 * np.asarray(seconds)
    return np.asarray(judge(cases, plans).success), times <= budget, times


def main() -> None:
    parser = argument_parser("real_time", __doc__, num=200, seed=1)
    parser.add_argument("--task", choices=TASKS, help="default: all of them")
    parser.add_argument("--planner", help="default: the published planners and the first")
    parser.add_argument("--suite", help="default: a suite of the task's paper")
    parser.add_argument("--budget-ms", type=float, help="default: by the task's paper")
    options = parser.parse_args()
    if not (options.task or options.planner is options.suite is None):
        parser.error("--planner and --suite need --task")
    if options.budget_ms is not None and not options.budget_ms > 0.0:
        parser.error(f"argument --budget-ms: must be > 0, got {options.budget_ms:g}")
    with begin(parser, options) as bench:
        bench.say(
            f"{processor()}, {usable_cores()} cores, {jax.devices()[0].platform}"
            f", jax {jax.__version__}",
            "| task | suite | planner | cases | accepted | in time | both | budget | p50 | p99 "
            "| max | load |",
            "|---|---|---|---|---|---|---|---|---|---|---|---|",
        )
        for name in [options.task] if options.task else TASKS:
            usual, planners, budget = TASKS[name]
            suite, task = options.suite or usual, task_named(name)
            budget = options.budget_ms or budget
            cases = jax.tree.map(np.asarray, task.draw(options.num, suite, options.seed))
            for planner in [options.planner] if options.planner else planners:
                try:
                    made = task.planner(planner)
                except ModuleNotFoundError as error:
                    print(error, file=sys.stderr)
                    continue
                good, soon, times = measure(made, task.judge, cases, budget)
                bench.count(good & soon)
                p50, p99, longest = np.percentile(times, [50, 99, 100])
                shares = [f"{100 * each.mean():.1f} %" for each in (good, soon, good & soon)]
                bench.say(
                    f"| {name} | {suite} | {planner} | {good.size} | {' | '.join(shares)} | "
                    f"{budget:g} ms | {p50:.2f} ms | {p99:.2f} ms | {longest:.2f} ms | "
                    f"{os.getloadavg()[0]:.1f} |"
                )
                bench.row(task=name, suite=suite, planner=planner, budget_ms=budget,
                          accepted=good.mean(), in_time=soon.mean(), both=(good & soon).mean(),
                          p50_ms=p50, p99_ms=p99, max_ms=longest)  # fmt: skip


if __name__ == "__main__":
    main()
