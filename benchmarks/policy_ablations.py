"""Measure the effect of each part of a policy's training, by leaving out one at a time.

    python -m benchmarks.policy_ablations [--suite triangle3] [--decisions 1500000] [--seeds 3]
        [--variants whole,mlp,...] [--num 1000] [--seed 777] [--out DIR]

A policy decides in which order and when a quadrotor catches several balls. It is trained by
reinforcement learning. The variants of the training are:
* "whole": the training of `planner-jax train`. It has an attention network, plans every decision,
  and rewards success, an early last catch, and decided times that are close to the optimised times;
* "mlp": a multilayer perceptron instead of the attention network;
* "estimate": decisions are rewarded by an estimate of the times, without a planner;
* "no last" and "no ratio": the reward lacks the term of the last catch or of the decided times;
* "small": the network of [Yu2023catch, Section IV-B], 100 environments as in the paper, and a tenth
  of the decisions. Even so its training takes longer than the other variants.

The trained policies decide on cases of a seed that no training uses. The planner `exact` plans
these cases, and the referee, an independent check in float64, judges the plans. The table has means
over accepted plans of the time of the last catch and of the optimal time ratio (OTR), which is the
relative difference between decided and optimised times. Of several training seeds the minimum and
maximum are printed. Training times include compilation.
"""

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin, parse_names
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.policies.policy import Policy
from planner_jax.policies.settings import WEIGHTS
from planner_jax.policies.training import Part, Training, train
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.catch.spec import SUITES

ITERATIONS = 25  # Number of the planner's iterations for each decision in training.
# Name of a variant of the training -> arguments of `training_settings` that differ from defaults.
VARIANTS: dict[str, dict[str, Any]] = {
    "whole": {},
    "mlp": {"network": "mlp"},
    "estimate": {"iterations": 0},
    "no last": {"weights": {"last": 0.0}},
    "no ratio": {"weights": {"ratio": 0.0}},
    "small": {"network": "mlp", "num_envs": 100, "minibatches": 4, "share": 0.1},
}
FIGURES = ("success", "last", "ratio", "seconds")


def training_settings(
    suite: str,
    decisions: int,
    seed: int,
    *,
    iterations: int = ITERATIONS,
    share: float = 1.0,
    weights: Mapping[str, float] | None = None,
    **others: Any,
) -> Training:
    """Return the settings of one training of a policy.

    Args:
        suite: suite of catches on which the policy is trained.
        decisions: number of decisions in training.
        seed: seed of the training.
        iterations: number of the planner's iterations for each decision.
        share: factor of the number of decisions.
        weights: weights of terms of the reward that differ from the defaults.
        **others: other fields of `Training`.
    """
    part = Part(steps=int(share * decisions), iterations=(iterations,))
    terms = tuple({**WEIGHTS, **(weights or {})}.items())
    usual = Training(suites=(suite,), parts=(part,), seed=seed, weights=terms, eval_cases=0)
    return dataclasses.replace(usual, **others)


def judge_decision(
    bench: Bench, decision: Any, suite: str, options: argparse.Namespace
) -> dict[str, float]:
    """Plan a suite's cases with a method that decides order and times, and judge the plans.

    The successes are added to the run's summary. Returns the success rate [%], the mean time of the
    last catch [s], and the mean relative difference between decided and optimised times.
    """
    cases: Any = jax.tree.map(np.asarray, pj.catch.draw(options.num, suite, options.seed))
    plans = pj.plan(DecidedPlanner(CatchProblem.planner(), decision), cases)
    good = pj.catch.judge(cases, plans).success
    bench.count(good)
    return {
        "success": 100.0 * good.mean(),
        "last": float(plans.times[good, -1].mean()) if good.any() else np.nan,
        "ratio": pj.catch.optimal_time_ratio(cases, plans)[good].mean() if good.any() else np.nan,
    }


def measure(bench: Bench, variants: list[str], options: argparse.Namespace) -> None:
    """Train and judge every variant of the training, and print the table.

    The first two rows need no training: `best` plans the six most promising orders of the balls and
    uses the best plan, and `greedy` always catches next the ball that can be caught first.
    """
    bench.say(
        f"{options.suite}, {options.decisions:,} decisions, {options.seeds} seeds, judged on "
        f"{options.num} cases of seed {options.seed}, {jax.devices()[0]}",
        "| variant | refereed | last catch | OTR | training |",
        "|---|---|---|---|---|",
    )
    for name in ("best", "greedy"):
        decision = pj.catch.Best() if name == "best" else pj.catch.Greedy()
        one = judge_decision(bench, decision, options.suite, options)
        bench.row(variant=name, **one)
        bench.say(
            f"| `{name}`, not trained | {one['success']:.1f} % | {one['last']:.3f} s "
            f"| {one['ratio']:.3f} | |"
        )
    for name in variants:
        report_seeds(
            bench,
            {"variant": name},
            lambda seed, name=name: train_policy(
                training_settings(options.suite, options.decisions, seed, **VARIANTS[name])
            ),
            options,
        )


def train_policy(training: Training) -> Policy:
    """Train a policy with given settings; the training's files are deleted afterwards."""
    with tempfile.TemporaryDirectory() as scratch:
        return train(training, scratch, progress=False)


def report_seeds(
    bench: Bench,
    named: Mapping[str, str],
    train_by: Callable[[int], Any],
    options: argparse.Namespace,
) -> None:
    """Train a policy with every seed, judge the policies, and print their minima and maxima.

    Args:
        bench: stores a row for each seed.
        named: heading of the table's first column -> name of the training.
        train_by: function that trains a policy with a seed.
        options: command-line options with `suite`, `seeds` (their number), `num` and `seed`.
    """
    rows = []
    for seed in range(options.seeds):
        began = time.perf_counter()
        found = train_by(seed)
        seconds = time.perf_counter() - began
        rows.append({**judge_decision(bench, found, options.suite, options), "seconds": seconds})
        bench.row(**named, seed=seed, **rows[-1])
    least, largest = (
        {key: choose(row[key] for row in rows) for key in FIGURES} for choose in (min, max)
    )
    bench.say(
        f"| {', '.join(named.values())} | {least['success']:.1f} to {largest['success']:.1f} % "
        f"| {least['last']:.3f} to {largest['last']:.3f} s "
        f"| {least['ratio']:.3f} to {largest['ratio']:.3f} "
        f"| {least['seconds']:.0f} to {largest['seconds']:.0f} s |"
    )


def main() -> None:
    parser = argument_parser("policy_ablations", __doc__, num=1000, seed=777, seeds=3)
    parser.add_argument("--suite", default="triangle3", choices=SUITES, help="default: triangle3")
    parser.add_argument(
        "--decisions",
        type=at_least(1000),
        default=1_500_000,
        metavar="N",
        help="decisions in training; default: 1,500,000",
    )
    parser.add_argument("--variants", default=",".join(VARIANTS), help="variants, comma-separated")
    options = parser.parse_args()
    variants = parse_names(parser, "--variants", options.variants, VARIANTS)
    with begin(parser, options) as bench:
        measure(bench, variants, options)


if __name__ == "__main__":
    main()
