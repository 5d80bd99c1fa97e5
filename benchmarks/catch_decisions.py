"""Compare methods that decide order and times of catches, as in Table III of [Yu2023catch].

    python -m benchmarks.catch_decisions [--suites triangle3,hexagon6] [--num 1000] [--seed 777]
        [--policy FILE] [--timed 200] [--out DIR]

A quadrotor catches several flying targets with a net. A decision sets the order of the targets and
proposes a time for each catch. The planner `exact` then optimises the motion and the times. The
referee, an independent check in float64, judges every plan. The decisions are:
* `best`: plan the six most promising of all orders, and use the best plan;
* `greedy`: plan the one order that always catches next the target that can be caught first;
* `random`: plan a random order;
* `policy`: plan the mean action of a neural network, the shipped policy or the one in --policy;
* `policy, 6`: plan six proposals of this network, and use the plan with the earliest last catch.

If targets may be left out, `best` and `policy` search for orders, and continue 64 and 8 partial
orders. Four further rows have other numbers: 1 and 4 for `policy`, 4 and 8 for `best`.

"Caught" is the mean number of targets that successful plans catch; in some suites targets may be
left out. "Last catch" is the mean time of the last catch over accepted plans. The optimal time
ratio (OTR) is the mean relative difference between the proposed and the optimised times. "At 25" is
the success rate if the planner stops after 25 iterations from one first guess. The time of a
decision is for one case, without compilation, from one NumPy vector with the case's numbers to
another vector with order and times. No policy was trained on the cases of this seed.
"""

import argparse
import time
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.core.errors import ArgumentError
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.policies.policy import policy
from planner_jax.task.catch.decide import Random
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.catch.spec import SUITES

OTHERS = ("throws", "hard", "square4", "pentagon5", "heptagon7")
TRAINED_ON = [name for name in SUITES if name not in OTHERS]
SHORT = CatchProblem.planner(attempts=(Attempt(starts=1, solver=LbfgsConfig(max_steps=25)),))


def decision_time(decision: Any, cases: Any, num: int) -> float:
    """Measure the median time [s] to decide the order and times of catches, on a CPU.

    A compiled function maps a NumPy vector with one case's numbers to a vector with the decision.
    """
    cpu = jax.local_devices(backend="cpu")[0]
    lanes = [pj.take(cases, k % cases.batch_shape[0]) for k in range(num)]
    with jax.default_device(cpu):
        _, case_of = ravel_pytree(lanes[0])
        decide = jax.jit(lambda vector: ravel_pytree(decision.propose(case_of(vector)))[0])
        vectors = [np.asarray(ravel_pytree(case)[0]) for case in lanes]
        np.asarray(decide(vectors[0]))
        seconds = []
        for vector in vectors:
            began = time.perf_counter()
            np.asarray(decide(vector))
            seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))


def run_row(bench: Bench, suite: str, name: str, decision: Any, options: Any) -> dict[str, Any]:
    """Plan the cases of one suite; return the figures of its row in the table, by name.

    `decision`, called `name` in the table, sets the order and times of catches. The figures are
    success rates, caught targets, times, and the mean relative difference between the times that
    the decision proposes and the optimised times. The successes are added to the run's summary.
    """
    cases: Any = jax.tree.map(np.asarray, pj.catch.draw(options.num, suite, options.seed))
    plans = pj.plan(DecidedPlanner(CatchProblem.planner(), decision), cases)
    verdict = pj.catch.judge(cases, plans)
    success = verdict.success
    short = pj.plan(DecidedPlanner(SHORT, decision), cases)
    bench.count(success)
    # With optional targets, a plan after 25 iterations counts as success only if it catches at
    # least as many targets as the plan after all iterations.
    at_25 = pj.catch.judge(cases, short)
    at_25 = at_25.success & (at_25.num_caught >= verdict.num_caught)
    return {
        "suite": suite,
        "decide": name,
        "success": success.mean(),
        "caught": (verdict.num_caught * success).mean(),
        "last": plans.times[success, -1].mean() if success.any() else None,
        "ratio": pj.catch.optimal_time_ratio(cases, plans)[success].mean(),
        "at_25": at_25.mean(),
        "decision_ms": 1e3 * decision_time(decision, cases, options.timed),
    }


def measure(bench: Bench, suites: list[str], options: argparse.Namespace) -> None:
    """Print a row for each suite and each method to decide the order and times of catches."""
    decisions = {
        "best": pj.catch.Best(),
        "greedy": pj.catch.Greedy(),
        "random": Random(),
        "policy": policy(options.policy),
        "policy, 6": policy(options.policy, proposals=6),
    }
    bench.say(
        f"{options.num} cases each, seed {options.seed}, {jax.devices()[0]}",
        "| suite | decision | success | caught | last catch | ratio to best | OTR | at 25 "
        "| decision |",
        "|---|---|---|---|---|---|---|---|---|",
    )
    widths: dict[str, Any] = {
        **{f"policy, width {k}": policy(options.policy, width=k) for k in (1, 4)},
        **{f"best, width {k}": pj.catch.Best(finalists=1, width=k) for k in (4, 8)},
    }
    for suite in suites:
        best = None
        rows = {**decisions, **widths} if SUITES[suite].optional else decisions
        for name, decision in rows.items():
            row = run_row(bench, suite, name, decision, options)
            best = best or row["last"]
            bench.row(**row)
            bench.say(
                f"| {suite} | {name} | {100 * row['success']:.1f} % | {row['caught']:.2f} "
                f"| {row['last']:.3f} s "
                f"| {row['last'] / best:.3f} | {row['ratio']:.3f} | {100 * row['at_25']:.1f} % "
                f"| {row['decision_ms']:.3f} ms |"
            )


def main() -> None:
    parser = argument_parser("catch_decisions", __doc__, num=1000, seed=777, timed=200)
    parser.add_argument("--suites", default=",".join(TRAINED_ON), help="suites, comma-separated")
    parser.add_argument(
        "--policy",
        metavar="FILE",
        default="catch",
        help="policy file, or name of a shipped policy (default: catch)",
    )
    options = parser.parse_args()
    suites = parse_names(parser, "--suites", options.suites, SUITES)
    with begin(parser, options) as bench:
        try:
            measure(bench, suites, options)
        except ArgumentError as error:
            parser.error(str(error))


if __name__ == "__main__":
    main()
