"""Measure the decision policy of [Yu2023catch] as published, beside other decisions: Table III.

    python -m benchmarks.published_policy [--train] [--suites triangle3,hexagon6]
        [--starts hover,random] [--num 1000] [--seed 777] [--seeds 3] [--decisions 150000]
        [--num-envs 100] [--iterations 150] [--t-min 0.3] [--trained DIR] [--out DIR]

A decision sets the order in which a quadrotor catches targets, and a first guess of the times. The
planner `catch` of the same paper plans from every decision. The rows of a suite are:
* `greedy`, `best`, `policy`: rules, and the shipped policy;
* `untrained`: the published network with random weights, the mean of `--seeds` networks;
* `policy:published`: this network after training. There is a network for each suite and seed,
  trained from random states of the quadrotor. `--train` trains those that are not in the folder
  `--trained`, and continues interrupted trainings.

"Rule" is the rate by the paper's rule of success, which accepts limits exceeded by 5 %; "referee"
the rate by the referee, an independent check in float64. The optimal time ratio (OTR) is the mean
relative difference of decided and planned times, over the cases that are solved by the paper's
rule, with its 95 % interval. Of several seeds, the least and greatest value are printed. The
published limits, ranges of cases and weights are unknown, so that rates are comparable in kind
only. "Reward" is the mean of the first and last tenth of each training.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.baselines.catch.published import find_number
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin, parse_names
from planner_jax.core.choices import STARTS
from planner_jax.core.errors import ArgumentError
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.policies.networks import PublishedMlp
from planner_jax.policies.policy import policy
from planner_jax.policies.progress import read_rows
from planner_jax.policies.published import PAPER_RULE, PublishedPolicy
from planner_jax.policies.published_env import paper_planner
from planner_jax.policies.settings import LEAST_TIME, PAPER_DECISIONS
from planner_jax.runs.summary import wilson_interval
from planner_jax.task.catch.spec import SUITES

USUAL = ("parabola1", "parabola2", "paper-harmonic2", "triangle3", "hexagon6")


def draw_policy(suite: str, seed: int, t_min: float) -> PublishedPolicy:
    """Return the policy of [Yu2023catch] with random weights."""
    network = PublishedMlp(SUITES[suite].num_targets)
    params = network.init(jax.random.key(seed), jnp.zeros(network.features))
    return PublishedPolicy(params, network, t_min)


def train_all(options: argparse.Namespace, suite: str) -> list[Path]:
    """Train the missing networks of a suite; return the folders of finished trainings."""
    folders = [Path(options.trained) / f"{suite}-{seed}" for seed in range(options.seeds)]
    if options.train:
        from planner_jax.policies.training import published_training, train  # needs Brax

        for seed, folder in enumerate(folders):
            how = {"seed": seed, "iterations": (options.iterations,), "t_min": options.t_min}
            size = (options.decisions,), options.num_envs
            train(published_training(suite, *size, **how, starts="random", eval_cases=0), folder)
    return [folder for folder in folders if (folder / "policy.npz").exists()]


def measure(bench: Bench, cases: Any, decision: Any) -> dict[str, Any]:
    """Plan cases from a decision; return rates, the OTR, and the half width of its interval."""
    plans = pj.plan(DecidedPlanner(paper_planner(), decision), cases)
    good = pj.catch.judge(cases, plans, **PAPER_RULE).success
    ratio = pj.catch.optimal_time_ratio(cases, plans)[good]
    spread = 1.96 * ratio.std(ddof=1) / np.sqrt(good.sum()) if good.sum() > 1 else np.nan
    bench.count(accepted := pj.catch.judge(cases, plans).success)
    return {
        "referee": accepted.mean(),
        "rule": good.mean(),
        "rule_95": wilson_interval(int(good.sum()), len(good)),
        "ratio": ratio.mean() if good.any() else np.nan,
        "ratio_half_95": spread,
    }


def run_suite(bench: Bench, suite: str, options: argparse.Namespace) -> None:
    """Print a row for each kind of starts and each decision of one suite."""
    folders = train_all(options, suite)
    decisions: dict[str, Sequence[Any]] = {
        "greedy": [pj.catch.Greedy()],
        "best": [pj.catch.Best()],
        "policy": [policy()],
        "untrained": [draw_policy(suite, seed, options.t_min) for seed in range(options.seeds)],
        "policy:published": [policy(folder / "policy.npz") for folder in folders],
    }
    rewards = []
    for folder in folders:
        curve = [row["reward"] for row in read_rows(folder) if "reward" in row]
        tenth = max(len(curve) // 10, 1)
        rewards.append((np.mean(curve[:tenth]), np.mean(curve[-tenth:])))
    published = [find_number(quantity, suite) for quantity in ("success", "OTR")]
    for starts in options.starts:
        drawn = pj.catch.draw(options.num, suite, options.seed, starts=starts)
        cases: Any = jax.tree.map(np.asarray, drawn)
        for name, some in decisions.items():
            if not some:
                continue
            rows = [measure(bench, cases, decision) for decision in some]
            learned = rewards if name == "policy:published" else []
            bench.row(suite=suite, starts=starts, decide=name, seeds=rows, rewards=learned)
            rates = [span([100.0 * row[key] for row in rows], 1) for key in ("rule", "referee")]
            half = max(row["ratio_half_95"] for row in rows)
            ratio = f"{span([row['ratio'] for row in rows], 3)} ± {half:.3f}"
            curve = "; ".join(f"{first:.2f} to {last:.2f}" for first, last in learned) or "-"
            cells = [suite, starts, name, *(f"{rate} %" for rate in rates), ratio, curve]
            bench.say(f"| {' | '.join([*cells, *(str(each or '-') for each in published)])} |")


def span(values: Sequence[float], digits: int) -> str:
    """Format the least and the greatest of some numbers."""
    low, high = f"{min(values):.{digits}f}", f"{max(values):.{digits}f}"
    return low if low == high else f"{low} to {high}"


def main() -> None:
    counts = {"num": 1000, "seed": 777, "seeds": 3, "iterations": 150}
    parser = argument_parser("published_policy", __doc__, decisions=PAPER_DECISIONS, **counts)
    parser.add_argument("--suites", default=",".join(USUAL), help="suites, comma-separated")
    parser.add_argument("--starts", default=",".join(STARTS), help="default: hover,random")
    parser.add_argument("--num-envs", type=at_least(25), default=100, help="multiple of 25")
    parser.add_argument("--t-min", type=float, default=LEAST_TIME, help="least time of a catch [s]")
    parser.add_argument("--train", action="store_true", help="train the networks that are missing")
    parser.add_argument("--trained", default="runs/published-policy", help="folder of trainings")
    options = parser.parse_args()
    required = [name for name, suite in SUITES.items() if not suite.optional]
    suites = parse_names(parser, "--suites", options.suites, required)
    options.starts = parse_names(parser, "--starts", options.starts, STARTS)
    if options.num_envs % 25:
        parser.error(f"argument --num-envs: must be a multiple of 25, got {options.num_envs}")
    with begin(parser, options) as bench:
        pj.keep_compiled_programs()  # all seeds of a suite are trained by the same program
        bench.say(
            f"{options.num} cases each, seed {options.seed}, {jax.devices()[0]}",
            "| suite | starts | decision | rule | referee | OTR | reward | published rate "
            "| published OTR |",
            f"|{'---|' * 9}",
        )
        try:
            for suite in suites:
                run_suite(bench, suite, options)
        except ArgumentError as error:
            parser.error(str(error))


if __name__ == "__main__":
    main()
