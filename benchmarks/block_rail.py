"""What a rail under the arm's base is worth: blocks by its length, and by how quick it is.

    python -m benchmarks.block_rail [--num 200] [--regime R2] [--out DIR]

The base waits in the middle of a rail along y. For each ball that cannot be met from there it may
slide, every 0.1 m along the rail, and stop, while the joints stay as they are; then the arm moves.
"at once" is a base that stands at the place already when the ball is thrown: a bound of what
places alone are worth. Two homes: the authors', from which the pole bars the way to one side, and
one behind the pole.
"""

import dataclasses
from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.robot.arm_mjcf import irb1600
from planner_jax.sweep.block.settings import REGIMES
from planner_jax.task.block.card import SUITES

HOMES = {"the authors'": irb1600().home, "behind the pole": (0.0, -0.52, 0.858, 0.0, -0.337, 0.0)}
LENGTHS = (0.2, 0.4, 1.0)  # [m]
STEP = 0.1  # [m], between places
DRIVES = {"1 m/s, 5 m/s²": (1.0, 5.0), "2 m/s, 10 m/s²": (2.0, 10.0), "at once": (np.inf, np.inf)}


def main() -> None:
    """Print the table."""
    parser = argument_parser("block_rail", __doc__, num=200, seed=7)
    parser.add_argument("--suite", choices=list(SUITES), default="pole", help="default: pole")
    parser.add_argument("--regime", choices=REGIMES, default="R2", help="default: R2")
    parser.add_argument("--wide", action="store_true", help="balls off the shield's middle, aslant")
    options = parser.parse_args()
    kind: dict[str, Any] = {"regime": options.regime, "wide": options.wide}
    planner = pj.block.planner()
    with begin(parser, options) as bench:
        cases = pj.block.draw(options.num, options.suite, options.seed, **kind)
        cases = jax.tree.map(np.asarray, cases)
        bench.say(
            f"{options.num} throws, {options.suite}, seed {options.seed}, {options.regime}, "
            f"{'wide' if options.wide else 'strict'}",
            "",
            "| home | drive | length | blocked | of them after a slide | claims refused |",
            "|---|---|---|---|---|---|",
        )
        for home, angles in HOMES.items():
            waits = np.broadcast_to(np.asarray(angles, np.float32), (options.num, 6))
            arm = dataclasses.replace(cases.arm, home=waits)
            here = dataclasses.replace(cases, angles=waits, arm=arm)
            for drive, speeds in {"none": (1.0, 1.0), **DRIVES}.items():
                for length in (0.0,) if drive == "none" else LENGTHS:
                    steps = np.arange(1, round(0.5 * length / STEP) + 1) * STEP
                    rail = pj.block.Rail((*steps.tolist(), *(-steps).tolist()), *speeds)
                    found = pj.block.plan_on_rail(planner, here, rail)
                    success = pj.block.judge(found.cases, found.plans).success
                    slid = success & (found.place != 0.0)
                    refused = (pj.solved(found.plans) & ~success).sum()
                    bench.say(
                        f"| {home} | {drive} | {length:g} m | {100 * success.mean():.1f} % "
                        f"| {100 * slid.mean():.1f} % | {refused} |"
                    )
                    bench.row(home=home, drive=drive, length=length, blocked=success.mean())
        bench.count(success)


if __name__ == "__main__":
    main()
