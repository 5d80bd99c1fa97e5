"""Measure how long a planner takes for one case at a time, with success and cost of the plans.

    python -m benchmarks.latency [--num 2000] [--task hit] [--planner NAME] [--suite NAME]
        [--seed 1] [--elapsed S] [--out DIR]

Each plan is for another case of the suite, which is a family of random cases. The time is from the
case's arrays to the plan's arrays. It includes all preparations, all searches and the check of the
limits. Compile time is reported separately. With --elapsed S, interceptions are planned without
timing. Then re-planning is timed: each plan is planned again from the car's state S seconds after
the plan's start, for a target that continues on its path. Run the benchmark on an idle machine,
bound to one core; the load average is printed.
"""

import os
import time
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.cost_gap import cost_gaps, gap_figures
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.core.tasks import all_tasks, task_named
from planner_jax.plane.target import LaterPath
from planner_jax.runs.timing import measure_plans


def begin_replans(planner: Any, cases: Any, elapsed: float) -> tuple[Any, Any]:
    """Plan a batch of interceptions; return a planner for re-planning, and problems for it.

    In each problem the motion is planned again `elapsed` [s] after the start of a solved plan, from
    the car's state at this time.
    """
    plans = pj.plan(planner, cases)
    lanes = np.flatnonzero(pj.are_solved(plans) & (np.asarray(plans.time) > elapsed))
    cases, plans = jax.tree.map(np.asarray, pj.take((cases, plans), lanes))
    since: Any = np.full(len(lanes), elapsed, cases.time.dtype)
    again = planner.replanner()
    return again, again.begin(cases, plans, since, target=LaterPath(cases.target, since))


def main() -> None:
    parser = argument_parser("latency", __doc__, num=2000, seed=1)
    parser.add_argument("--task", choices=all_tasks(), default="hit", help="default: hit")
    parser.add_argument("--planner", help="default: the first of the task")
    parser.add_argument("--suite", help="default: the first of the task")
    parser.add_argument(
        "--elapsed", type=float, help="time re-plans of interceptions, this long into the plan [s]"
    )
    options = parser.parse_args()
    card = task_named(options.task)
    if options.elapsed is not None and options.task != "intercept":
        parser.error("--elapsed is for --task intercept")
    suite = options.suite or next(iter(card.suites))
    try:
        planner = card.planner(options.planner or next(iter(card.planners)))
        batch = jax.tree.map(np.asarray, card.draw(options.num, suite, options.seed))
    except ValueError as error:
        parser.error(str(error))
    with begin(parser, options) as bench:
        judged = batch
        if options.elapsed is not None:
            planner, batch = begin_replans(planner, batch, options.elapsed)
            judged = batch.case
        num = jax.tree.leaves(batch)[0].shape[0]
        began = time.perf_counter()
        pj.plan(planner, pj.take(batch, 0))
        first = time.perf_counter() - began
        plans, seconds = measure_plans(planner, batch)
        success = np.asarray(card.judge(judged, plans).success)
        p50, p90, p99 = 1e3 * np.percentile(seconds, [50, 90, 99])
        of_good = seconds[success] if success.any() else np.nan
        solved = 1e3 * np.percentile(of_good, [50, 90, 99])
        what = "re-plans" if options.elapsed is not None else "plans"
        bench.say(
            f"{num} {what} of {card.name}, suite {suite}, {jax.devices()[0].platform}, jax "
            f"{jax.__version__}, load average {os.getloadavg()[0]:.1f}",
            f"p50 {p50:.3f} ms, p90 {p90:.3f} ms, p99 {p99:.3f} ms; of successful plans "
            f"{solved[0]:.3f}, {solved[1]:.3f} and {solved[2]:.3f} ms; "
            f"first call with compilation {first:.1f} s",
            f"refereed success {100 * success.mean():.2f} %, "
            f"median cost {np.median(plans.cost[success]):.3g}",
        )
        gaps = cost_gaps(planner, batch, plans, card=card)
        bench.count(success, gaps)
        median, most, greatest = gap_figures(gaps).values()
        if median is not None and most is not None and greatest is not None:
            bench.say(
                f"cost above a longer search: {100.0 * median:.1f} % at the median, p90 "
                f"{100.0 * most:.1f} %, p99 {100.0 * greatest:.1f} %"
            )
        bench.note(
            p50_ms=p50,
            p90_ms=p90,
            p99_ms=p99,
            solved_p99_ms=solved[2],
            first_seconds=first,
            median_cost=np.median(plans.cost[success]),
        )


if __name__ == "__main__":
    main()
