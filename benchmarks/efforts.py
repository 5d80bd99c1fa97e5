"""Measure cost and time of plans for each effort: "feasible", "good" and "best".

    python -m benchmarks.efforts [--num 1000] [--seed 0] [--repeat 3] [--tasks hit,catch,block]
        [--out DIR]

The effort states how long a planner continues to search for a lower cost after every limit holds.
The planner is `exact`, for hits of the suite `court` and for catches of one and of two balls, where
the ball that can be caught first is caught first, and `online` for blocks of the suite `pole`. The
table has the share of plans that the referee, an independent check in float64, accepts; their cost
above the optimum; and the time of the fastest call without compilation. For hits and catches the
optimum is found by a long search from the same initial guess, which ends with Newton's method. For
blocks it is the least cost of 48 straight motions and of least squares from 64 starting points,
with up to 96 steps each, and of the plan itself.
"""

import argparse
import dataclasses
import time
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.cost_gap import cost_gaps, gap_figures
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.core.choices import EFFORTS
from planner_jax.task.block.default_planner import OnlineBlock

SUITES = (("hit", "court"), ("catch", "throws"), ("catch", "parabola2"), ("block", "pole"))
PLANNERS = {"hit": "exact", "catch": "exact", "block": "online"}


def measure(bench: Bench, options: argparse.Namespace) -> None:
    """Plan every suite with every effort, and print a row for each combination.

    The effort "feasible", "good" or "best" sets how long a planner searches for a lower cost.
    """
    bench.say(
        f"{options.num:,} cases, {jax.devices()[0].device_kind}, jax {jax.__version__}",
        "| task | suite | effort | refereed | cost above the optimum (median, p90, p99) | "
        "fastest [s] |",
        "|---|---|---|---|---|---|",
    )
    accepted, gaps = [], []
    for name, suite in SUITES:
        if name not in options.tasks:
            continue
        task = pj.task_named(name)
        cases: Any = jax.tree.map(np.asarray, task.draw(options.num, suite, options.seed))
        longest = _plan_blocks_long(cases) if name == "block" else None
        for effort in EFFORTS:
            planner = task.planner(PLANNERS[name], effort=effort, **task.bench)
            plans, seconds = _time_fastest(planner, cases, options.repeat)
            success = task.judge(cases, plans).success
            if longest is None:
                gap = cost_gaps(planner, cases, plans, card=task)
            else:
                both = success & pj.are_solved(longest)
                gap = np.maximum(plans.cost[both] / longest.cost[both] - 1.0, 0.0)
            accepted.append(success)
            gaps.append(gap)
            figures = gap_figures(gap)
            bench.row(
                task=name,
                suite=suite,
                effort=effort,
                success_rate=success.mean(),
                seconds=seconds,
                **figures,
            )
            above = ", ".join(f"{100.0 * (each or 0.0):.2f} %" for each in figures.values())
            bench.say(
                f"| {name} | {suite} | {effort} | {100.0 * success.mean():.1f} % | {above} | "
                f"{seconds:.2f} |"
            )
    bench.count(np.concatenate(accepted))
    bench.note(**gap_figures(*gaps))


def _plan_blocks_long(cases: Any) -> Any:
    best = OnlineBlock().with_effort("best")
    search, *later = best.searches
    solver = dataclasses.replace(search.solver, max_steps=96, hope=None)
    search = dataclasses.replace(search, tries=64, solver=solver)
    return pj.plan(dataclasses.replace(best, searches=(search, *later), settling=96), cases)


def _time_fastest(planner: Any, cases: Any, repeat: int) -> tuple[Any, float]:
    """Return plans, and the duration [s] of the fastest of `repeat` calls without compilation."""
    plans, seconds = pj.plan(planner, cases), []
    for _ in range(repeat):
        began = time.perf_counter()
        plans = pj.plan(planner, cases)
        seconds.append(time.perf_counter() - began)
    return plans, min(seconds)


def main() -> None:
    parser = argument_parser("efforts", __doc__, num=1000, seed=0, repeat=3)
    parser.add_argument("--tasks", default=",".join(PLANNERS), help="default: all of them")
    options = parser.parse_args()
    options.tasks = parse_names(parser, "--tasks", options.tasks, PLANNERS)
    with begin(parser, options) as bench:
        measure(bench, options)


if __name__ == "__main__":
    main()
