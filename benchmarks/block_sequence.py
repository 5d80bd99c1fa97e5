"""Balls in sequence: how many of them the arm blocks, from where the last one has left it.

    python -m benchmarks.block_sequence [--num 300] [--balls 3] [--apart 0.8] [--out DIR]

Unless they are stopped, the balls of a sequence get into the protected box `--apart` seconds after
each other. The arm knows a ball from the moment at which it is thrown, so that it is often on its
way to one when it sees the next; planning takes no time. The referee judges each ball as a case of
its own, which starts when, where and as fast as the motion to the last one ends.

* `alone`: the same balls, each for itself and from home, as in all other tables.
* `greedy`: each ball is met wherever its plan likes; an arm that knows of no ball stands.
* `greedy, returns`: the same, but then it goes back towards its home.
* `reconsiders`: the motion to a ball is planned anew where the next one could not be met after it.
* `foreknown`: the same by an arm that knows all balls of its sequence from the beginning, and may
  start for each as soon as it has met the last. This is the informed bound: of knowledge, by the
  same search; it is no proof that more cannot be blocked.
"""

import argparse
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.studies.block import sequence
from planner_jax.sweep.block.settings import REGIMES
from planner_jax.task.block.spec import SUITES

WAYS: dict[str, dict[str, bool]] = {
    "greedy": {"reconsiders": False, "returns": False},
    "greedy, returns": {"reconsiders": False},
    "reconsiders": {},
    "foreknown": {"foreknown": True},
}
REPORTED = "reconsiders"


def gap(text: str) -> tuple[float, float]:
    """A time [s] between two balls, or the shortest and the longest one."""
    shortest, _, longest = text.partition("-")
    try:
        pair = float(shortest), float(longest or shortest)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be such as 0.8 or 0.6-1.2, got {text}") from None
    if not 0.0 < pair[0] <= pair[1] < np.inf:
        raise argparse.ArgumentTypeError(f"must be > 0, finite and no falling pair, got {text}")
    return pair


def main() -> None:
    """Print one table for each time between balls."""
    parser = argument_parser("block_sequence", __doc__, num=300, seed=7, balls=3)
    parser.add_argument(
        "--apart",
        type=gap,
        nargs="+",
        default=[(0.8, 0.8)],
        help="[s], or the shortest and the longest time, such as 0.6-1.2; default: 0.8",
    )
    parser.add_argument("--suite", choices=list(SUITES), default="pole", help="default: pole")
    parser.add_argument("--regime", choices=REGIMES, default="R2", help="default: R2")
    parser.add_argument("--strict", action="store_true", help="balls in the middle, straight on")
    parser.add_argument("--delay", type=float, default=0.0, help="[s]; default: 0")
    options = parser.parse_args()
    planner = pj.block.planner()
    places = range(1, options.balls + 1)
    with begin(parser, options) as bench:
        for apart in options.apart:
            sequences = sequence.draw_sequences(
                options.num,
                options.suite,
                options.seed,
                balls=options.balls,
                apart=apart,
                regime=options.regime,
                wide=not options.strict,
                delay=options.delay,
            )
            between = f"{apart[0]:g}" if apart[0] == apart[1] else f"{apart[0]:g} to {apart[1]:g}"
            seen = np.diff(np.asarray(sequences.seen), axis=1)
            bench.say(
                f"{options.num} sequences of {options.balls} balls {between} s apart, "
                f"{options.suite}, seed {options.seed}, {options.regime}, "
                f"{'strict' if options.strict else 'wide'}, delay {options.delay:g} s; a ball is "
                f"seen {seen.mean():.2f} ± {seen.std():.2f} s after the one before",
                "",
                f"| way | blocked | {' | '.join(f'ball {k}' for k in places)} | of `alone` "
                "| claims refused |",
                f"|---|{'---|' * (options.balls + 3)}",
            )
            alone = jax.tree.map(
                lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:]), sequences.balls
            )
            reference = None
            for name in ("alone", *WAYS):
                if name == "alone":
                    plans = pj.plan(planner, alone)
                    success = pj.block.judge(alone, plans).success.reshape(sequences.seen.shape)
                    claimed = pj.solved(plans).reshape(success.shape)
                    reference = success.mean()
                else:
                    planned = sequence.plan_in_turn(planner, sequences, **WAYS[name])
                    success = sequence.judge_in_turn(planned).success
                    claimed = pj.solved(planned.plans)
                if name == REPORTED:
                    bench.count(success)
                rates = [100.0 * success.mean(), *(100.0 * success.mean(axis=0))]
                figures: dict[str, Any] = {
                    "of_alone": success.mean() / reference,
                    "refused": (claimed & ~success).sum(),
                }
                bench.say(
                    f"| {name} | {' | '.join(f'{rate:.1f} %' for rate in rates)} "
                    f"| {100.0 * figures['of_alone']:.1f} % | {figures['refused']} |"
                )
                bench.row(way=name, apart=apart, blocked=rates[0], by_place=rates[1:], **figures)
            bench.say("")


if __name__ == "__main__":
    main()
