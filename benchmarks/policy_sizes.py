"""Measure a policy of catches with numbers of targets that it was not trained on.

    python -m benchmarks.policy_sizes [--sizes 4,5,7] [--num 1000] [--seed 777]
        [--decisions 1500000] [--policy FILE] [--init-from FILE] [--out DIR]

A policy decides in which order and when a quadrotor catches several targets. The suites `square4`,
`pentagon5` and `heptagon7` have four, five and seven targets. Otherwise they equal `hexagon6`, one
of the suites on which the shipped policy was trained. The rows of each suite are
* "best": plan the six most promising of all orders (with seven targets, of the orders that a search
  finds), and use the best plan;
* "greedy": plan the one order that always catches next the target that can be caught first;
* "policy": the policy in --policy, by default the shipped policy, without further training;
* "trained": a policy trained on this suite with --decisions decisions and the shipped policy's
  reward. It starts with the weights of --init-from, by default of --policy.

The planner `exact` plans all cases, and the referee, an independent check in float64, judges the
plans. The table has means over accepted plans of the time of the last catch and of the optimal time
ratio (OTR), which is the relative difference between decided and optimised times. Training times
include compilation.
"""

import argparse
import tempfile
import time
from typing import Any

import jax

import planner_jax as pj
from planner_jax.benchmarks.policy_ablations import judge_decision
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin, parse_names
from planner_jax.core.errors import ArgumentError
from planner_jax.policies.policy import Policy, policy
from planner_jax.policies.settings import WEIGHTS, usual_iterations
from planner_jax.policies.training import Part, Training, train

SUITES = {"4": "square4", "5": "pentagon5", "7": "heptagon7"}
REWARD = {**WEIGHTS, "solved": 5.0, "last": 10.0, "ratio": -14.0}


def train_on_suite(suite: str, options: argparse.Namespace) -> tuple[Policy, float]:
    """Train a policy on one suite, and return it and the duration [s].

    The training starts with the weights in the option --init-from or --policy.
    """
    training = Training(
        suites=(suite,),
        parts=(Part(options.decisions, (usual_iterations(suite),)),),
        num_envs=510 if jax.default_backend() == "cpu" else 8190,
        weights=tuple(REWARD.items()),
        init_from=options.init_from or options.policy,
        eval_cases=0,
    )
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        found = train(training, scratch)
    return found, time.perf_counter() - began


def measure(bench: Bench, sizes: list[str], options: argparse.Namespace) -> None:
    bench.say(
        f"{options.num} cases each, seed {options.seed}; trained with {options.decisions:,} "
        f"decisions, {jax.devices()[0]}",
        "| suite | decision | refereed | last catch | ratio to best | OTR | training |",
        "|---|---|---|---|---|---|---|",
    )
    given, short = policy(options.policy), []
    for suite in (SUITES[size] for size in sizes):
        own, seconds = train_on_suite(suite, options)
        decisions: dict[str, Any] = {
            "best": pj.catch.Best(),
            "greedy": pj.catch.Greedy(),
            "policy": given,
            "trained": own,
        }
        rows = {name: judge_decision(bench, decisions[name], suite, options) for name in decisions}
        for name, row in rows.items():
            spent = seconds if name == "trained" else None
            bench.row(suite=suite, decide=name, seconds=spent, **row)
            bench.say(
                f"| {suite} | {name} | {row['success']:.1f} % | {row['last']:.3f} s "
                f"| {row['last'] / rows['best']['last']:.3f} | {row['ratio']:.3f} "
                f"| {'' if spent is None else f'{spent:.0f} s'} |"
            )
        behind = rows["trained"]["success"] - rows["policy"]["success"]
        short.append(f"{behind:.1f} on {suite}")
        bench.note(**{f"{suite}_points_behind": behind})
    bench.say(
        "", f"Success below a policy trained on the suite, in percentage points: {', '.join(short)}"
    )


def main() -> None:
    parser = argument_parser("policy_sizes", __doc__, num=1000, seed=777)
    parser.add_argument(
        "--sizes", default=",".join(SUITES), help="numbers of targets, comma-separated"
    )
    parser.add_argument(
        "--decisions",
        type=at_least(1000),
        default=1_500_000,
        metavar="N",
        help="decisions in training; default: 1,500,000",
    )
    shipped = "policy file, or name of a shipped policy"
    parser.add_argument(
        "--policy", metavar="FILE", default="catch", help=f"{shipped} (default: catch)"
    )
    parser.add_argument("--init-from", metavar="FILE", help=f"{shipped} (default: as --policy)")
    options = parser.parse_args()
    sizes = parse_names(parser, "--sizes", options.sizes, SUITES)
    with begin(parser, options) as bench:
        try:
            measure(bench, sizes, options)
        except ArgumentError as error:
            parser.error(str(error))


if __name__ == "__main__":
    main()
