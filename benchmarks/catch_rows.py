"""Measure how often catch planners succeed on every suite, beside the rates of [Yu2023catch].

    python -m benchmarks.catch_rows [--suites throws,hard] [--planners exact,catch,mpp]
        [--decide best] [--num 1000] [--seed 0] [--out DIR]

A quadrotor catches flying targets with a net. A suite is a family of random cases. The option
--decide sets how the order of several targets is chosen; `best` plans the six most promising orders
and uses the best plan. The planners are `exact`, the default; `catch`, which reimplements
[Yu2023catch]; and `mpp`, the motion primitives of [Mueller2015].

The referee, an independent check in float64, judges every plan with a relative tolerance of 1e-3.
The planner `catch` treats limits as penalties, so its plans exceed limits slightly. Every plan is
therefore judged a second time by the protocol of the published C++ program, which accepts limits
exceeded by up to 5 % and requires the ball within the net's radius of its centre. The paper states
no latest time of a catch, so a further column has the rate without this limit ("at any time").
"""

import argparse
import dataclasses
import functools
import time
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.baselines.catch.published import find_number
from planner_jax.benchmarks.cost_gap import cost_gaps, gap_figures
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.policies.published import PAPER_RULE
from planner_jax.runs.summary import wilson_interval
from planner_jax.task.catch.spec import DECISIONS, SUITES, TASK


def run_row(bench: Bench, suite: str, name: str, options: argparse.Namespace) -> dict[str, Any]:
    num, seed = options.num, options.seed
    planner, cases = pj.catch.planner(name, decide=options.decide), pj.catch.draw(num, suite, seed)
    began = time.perf_counter()
    pj.plan(planner, cases)
    first = time.perf_counter() - began
    began = time.perf_counter()
    plans = pj.plan(planner, cases)
    warm = time.perf_counter() - began
    verdict = pj.catch.judge(cases, plans)
    protocol = functools.partial(pj.catch.judge, plans=plans, **PAPER_RULE)
    ever = dataclasses.replace(cases, horizon=np.full_like(cases.horizon, np.inf))
    success, gaps = verdict.success, cost_gaps(planner, cases, plans)
    bench.count(success, gaps)
    ratio = pj.catch.optimal_time_ratio(cases, plans)
    return {
        "suite": suite,
        "planner": name,
        "decide": options.decide,
        "num": num,
        "seed": seed,
        "success": success.mean(),
        "wilson_95": wilson_interval(int(success.sum()), num),
        "success_protocol": protocol(cases).success.mean(),
        "success_protocol_any_time": protocol(ever).success.mean(),
        "caught": verdict.num_caught.mean() / SUITES[suite].num_targets,
        "optimal_time_ratio": ratio[success].mean() if success.any() else None,
        "mean_last_catch": plans.times[success, -1].mean() if success.any() else None,
        **gap_figures(gaps),
        "first_seconds": first,
        "warm_seconds": warm,
        "plans_per_second_warm": num / warm,
    }


def main() -> None:
    parser = argument_parser("catch_rows", __doc__, num=1000, seed=0)
    parser.add_argument(
        "--suites", default=",".join(SUITES), help="suites, comma-separated; default: all"
    )
    parser.add_argument(
        "--planners",
        default="exact",
        help=f"planners, of {', '.join(TASK.planners)}; default: exact",
    )
    parser.add_argument("--decide", choices=DECISIONS, default="best", help="default: best")
    options = parser.parse_args()
    suites = parse_names(parser, "--suites", options.suites, SUITES)
    names = parse_names(parser, "--planners", options.planners, TASK.planners)
    with begin(parser, options) as bench:
        bench.say(
            f"{options.num} cases each, seed {options.seed}, decide {options.decide}, "
            f"{jax.devices()[0]}",
            "| suite | planner | success | 95 % | by the protocol | at any time | paper | OTR "
            "| last catch | warm |",
            "|---|---|---|---|---|---|---|---|---|---|",
        )
        for suite, name in ((suite, name) for suite in suites for name in names):
            row = run_row(bench, suite, name, options)
            low, high = row["wilson_95"]
            ratio, last = (
                "-" if row[key] is None else f"{row[key]:.3f}"
                for key in ("optimal_time_ratio", "mean_last_catch")
            )
            bench.say(
                f"| {suite} | {name} | {100 * row['success']:.2f} % | "
                f"{100 * low:.2f}..{100 * high:.2f} | {100 * row['success_protocol']:.2f} % | "
                f"{100 * row['success_protocol_any_time']:.2f} % | "
                f"{find_number('success', suite) or '-'} | {ratio} | {last} s | "
                f"{row['warm_seconds']:.2f} s |"
            )
            bench.row(**row)


if __name__ == "__main__":
    main()
