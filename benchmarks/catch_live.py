"""Targets that appear one by one: caught by decision, beside a search that knows them in advance.

    python -m benchmarks.catch_live [--num 300] [--seed 777] [--decide greedy,best,random,policy]
        [--spans 6] [--policy FILE] [--out DIR]

Eight balls that sink all around, each known only from its appearance on, at a moment that is even
between 0 and the span [s] (`planner_jax.studies.catch.appearing`). At every appearance and every
catch the decision is asked anew, the planner `exact` plans from the state in which the quadrotor
is, and all that was flown is refereed as one plan of the case. "greedy" takes next whatever can be
caught
earliest, "random" any, "best" the better one of the two most promising orders of a search, and
"policy" the order and times of the shipped policy or that of --policy; all of them also with the
last catch or the last two left out. "known" is the plan of a long search, sixteen orders in three
lengths, that knows from the start what will appear, where and when: what knowing is worth. It plans
once and from a rougher estimate, so single cases may do better without it; "most" counts for each
case the most that any row caught. A case counts as many as it caught if the referee accepts it, and
else none. Last catches are means over accepted cases with a catch. Seconds include compilation.
"""

import argparse
import time
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, begin, chosen
from planner_jax.core.errors import ArgumentError
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.policies.policy import policy
from planner_jax.referee.catch import CatchVerdict
from planner_jax.studies.catch.appearing import SPAN, draw_appearing, states_of
from planner_jax.studies.catch.live import fly_live, judge_live
from planner_jax.task.catch.decide import Random

LONG = pj.catch.Best(finalists=16, width=256)
DECISIONS = ("greedy", "best", "random", "policy")


def decision_of(name: str, file: str) -> Any:
    """The decision of a row."""
    if name == "policy":
        return policy(file)
    known = {
        "greedy": pj.catch.Greedy(),
        "best": pj.catch.Best(finalists=2, width=16),
        "random": Random(),
    }
    return known[name]


def known_from_the_start(cases: Any) -> tuple[CatchVerdict, np.ndarray]:
    """The verdict on, and the last catch [s] (B,) of, one plan that knows all targets."""
    cases = jax.tree.map(np.asarray, cases)
    plans: Any = pj.plan(DecidedPlanner(pj.catch.ExactCatch(), LONG), cases)
    return pj.catch.judge(cases, plans, target_states=states_of), plans.times[:, -1]


def played(cases: Any, decision: Any) -> tuple[CatchVerdict, np.ndarray]:
    """The same of flights in which targets appear."""
    flown = fly_live(cases, decision)
    return judge_live(flown), np.asarray(flown.plans.times)[:, -1]


def run_span(bench: Bench, span: float, names: list[str], options: argparse.Namespace) -> None:
    """All rows of one span."""
    cases = draw_appearing(options.num, options.seed, span=span)
    most = np.zeros(options.num)
    for name in ("known", *names):
        began = time.perf_counter()
        if name == "known":
            verdict, last = known_from_the_start(cases)
        else:
            verdict, last = played(cases, decision_of(name, options.policy))
            bench.count(verdict.success)
        seconds = time.perf_counter() - began
        caught = verdict.num_caught * verdict.success
        fails = [str(limit) for limit in verdict.failed_limit[~verdict.success]]
        most = np.maximum(most, caught)
        some = caught > 0
        row = {
            "span": span,
            "decide": name,
            "success": verdict.success.mean(),
            "fails": {limit: fails.count(limit) for limit in sorted(set(fails))},
            "caught": caught.mean(),
            "last": last[some].mean() if some.any() else None,
            "seconds": seconds,
        }
        bench.row(**row)
        bench.note(**{f"{name}_caught_span_{span:g}": row["caught"]})
        ends = "-" if row["last"] is None else f"{row['last']:.2f} s"
        bench.say(
            f"| {span:g} s | {name} | {100 * row['success']:.1f} % | {row['caught']:.2f} "
            f"| {ends} | {seconds:.0f} s |"
        )
    bench.row(span=span, decide="most", caught=most.mean())
    bench.say(f"| {span:g} s | most | | {most.mean():.2f} | | |")


def main() -> None:
    """Print the table."""
    parser = argument_parser("catch_live", __doc__, num=300, seed=777)
    parser.add_argument("--decide", default=",".join(DECISIONS), help="comma-separated")
    parser.add_argument("--spans", default=f"{SPAN:g}", help="[s], comma-separated")
    parser.add_argument(
        "--policy", metavar="FILE", default="catch", help="or one that is shipped (default: catch)"
    )
    options = parser.parse_args()
    names = chosen(parser, "--decide", options.decide, DECISIONS)
    try:
        spans = [float(text) for text in options.spans.split(",")]
    except ValueError:
        parser.error(f"argument --spans: must be numbers, got {options.spans!r}")
    with begin(parser, options) as bench:
        bench.say(
            f"{options.num} cases each of 8 targets, seed {options.seed}, {jax.devices()[0]}",
            "| span | decision | refereed | caught of 8 | last catch | took |",
            "|---|---|---|---|---|---|",
        )
        try:
            for span in spans:
                run_span(bench, span, names, options)
        except ArgumentError as error:
            parser.error(str(error))


if __name__ == "__main__":
    main()
