"""Measure how many hard balls per second are planned, on all cores of the machine.

    python -m benchmarks.block_hard [--num 2000] [--seed 20261] [--regime R2] [--repeat 3]
        [--out DIR]

A robot arm blocks thrown balls with a shield. A ball is hard if no straight motion blocks it, that
is no motion in which all joints move in proportion. Balls are drawn from the suite `pole`, and
balls that a straight motion blocks are left out: nearly three in four with the joint limits R2.
Hard balls need a search by least squares, or cannot be blocked at all. All hard balls are planned
in one call of a compiled program, and the fastest of --repeat calls is reported.

The program also prints the share of balls that the referee, an independent check in float64,
accepts as blocked. The motions' costs are compared with the costs of motions that the planner finds
with the effort "best".
"""

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.block_rows import STRAIGHT
from planner_jax.benchmarks.cost_gap import cost_gaps, gap_figures
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.core.registry import task_named
from planner_jax.runs.timing import measure_warm
from planner_jax.sweep.block.settings import REGIMES


def main() -> None:
    parser = argument_parser("block_hard", __doc__, num=2000, seed=20261, repeat=3)
    parser.add_argument("--regime", choices=REGIMES, default="R2", help="default: R2")
    options = parser.parse_args()
    planner = pj.block.planner()
    with begin(parser, options) as bench:
        cases = pj.block.draw(options.num, "pole", options.seed, regime=options.regime)
        hard = np.flatnonzero(~pj.are_solved(pj.plan(STRAIGHT, cases)))
        if not hard.size:
            bench.say("A straight motion blocks every throw.")
            return
        some = jax.tree.map(np.asarray, pj.take(cases, hard))
        calls = [measure_warm(lambda: pj.plan(planner, some)) for _ in range(options.repeat)]
        (plans, _), seconds = calls[0], [each for _, each in calls]
        success = pj.block.judge(some, plans).success
        refused = int((pj.are_solved(plans) & ~success).sum())
        gaps = cost_gaps(planner, some, plans, card=task_named("block"))
        bench.count(success, gaps)
        bench.note(seconds=min(seconds), refused=refused)
        bench.say(
            f"{hard.size} of {options.num} throws have no straight motion: "
            f"{hard.size / min(seconds):.0f}/s, {100 * success.mean():.1f} % of them blocked, "
            f"{refused} plans solved by status but rejected."
        )
        median = gap_figures(gaps)["cost_gap_median"]
        if median is not None:
            bench.say(f"Motions cost {100.0 * median:.0f} % more than by effort best (median).")


if __name__ == "__main__":
    main()
