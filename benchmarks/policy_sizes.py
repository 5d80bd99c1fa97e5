"""Numbers of targets that a policy was not trained on, beside training on each of them.

    python -m benchmarks.policy_sizes [--sizes 4,5,7] [--num 1000] [--seed 777]
        [--decisions 1500000] [--policy FILE] [--init-from FILE] [--out DIR]

The suites are `square4`, `pentagon5` and `heptagon7`: as `hexagon6`, with other numbers of targets.
Rows: `best` plans the six most promising of all orders (of seven targets, of those that a search
finds), `greedy` one; "policy" is that of --policy, by default the shipped one, as it is; "trained"
is what a training on that very suite makes of the weights of --init-from, by default those of
--policy, with as many decisions as --decisions says and the weights of the shipped policy's reward.
Every plan is by `exact` and refereed; last catches and optimal time ratios (OTR) are of what the
referee accepts. Seconds are those of training, compilation included.
"""

import argparse
import tempfile
import time
from typing import Any

import jax

import planner_jax as pj
from planner_jax.benchmarks.policy_ablations import figures_of
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin, chosen
from planner_jax.core.errors import ArgumentError
from planner_jax.policies.policy import Policy, policy
from planner_jax.policies.settings import WEIGHTS, usual_iterations
from planner_jax.policies.training import Part, Training, train

SUITES = {"4": "square4", "5": "pentagon5", "7": "heptagon7"}
REWARD = {**WEIGHTS, "solved": 5.0, "last": 10.0, "ratio": -14.0}


def trained(suite: str, options: argparse.Namespace) -> tuple[Policy, float]:
    """A policy that goes on from given weights on one suite, and the seconds that it took."""
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
    """All rows."""
    bench.say(
        f"{options.num} cases each, seed {options.seed}; trained with {options.decisions:,} "
        f"decisions, {jax.devices()[0]}",
        "| suite | decision | refereed | last catch | of best's | OTR | training |",
        "|---|---|---|---|---|---|---|",
    )
    given, short = policy(options.policy), []
    for suite in (SUITES[size] for size in sizes):
        own, seconds = trained(suite, options)
        decisions: dict[str, Any] = {
            "best": pj.catch.Best(),
            "greedy": pj.catch.Greedy(),
            "policy": given,
            "trained": own,
        }
        rows = {name: figures_of(bench, decisions[name], suite, options) for name in decisions}
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
    bench.say("", f"Points of success behind one trained on the suite: {', '.join(short)}")


def main() -> None:
    """Print the table."""
    parser = argument_parser("policy_sizes", __doc__, num=1000, seed=777)
    parser.add_argument("--sizes", default=",".join(SUITES), help="comma-separated")
    parser.add_argument("--decisions", type=at_least(1000), default=1_500_000, metavar="N")
    shipped = "or one that is shipped"
    parser.add_argument("--policy", metavar="FILE", default="catch", help=f"{shipped}: catch")
    parser.add_argument("--init-from", metavar="FILE", help=f"{shipped} (default: as --policy)")
    options = parser.parse_args()
    sizes = chosen(parser, "--sizes", options.sizes, SUITES)
    with begin(parser, options) as bench:
        try:
            measure(bench, sizes, options)
        except ArgumentError as error:
            parser.error(str(error))


if __name__ == "__main__":
    main()
