"""Measure how many throws arms from files block: `python -m benchmarks.block_arms FILE ...`.

    python -m benchmarks.block_arms FILE [FILE ...] [--tip NAME] [--limits FILE] [--num 200]
        [--seed 977] [--suite open] [--mass 0] [--wide] [--long]

A file is an arm in MJCF or URDF that `pj.block.read_arm` reads; "irb1600" is the arm of the
library. --tip is the body or site at which a shield of 0.30 m and --mass kg is mounted. --limits is
a file with limits of the joints, by default `NAME.limits.yaml` beside the arm's file. --suite draws
the throws. The scene is scaled to the reach of each arm. The referee, an independent check in
float64, decides which balls are blocked. With --long, throws that the planner fails to block are
planned again from 192 starting points. The last column is then the share of blocks among the throws
that one of both blocks.
"""

import argparse
import time

import numpy as np

import planner_jax as pj
from planner_jax.robot.arm_file import irb1600
from planner_jax.task.block.search.attempts import Search

_STARTS = 192


def main() -> None:
    """Read the arms, and print one row of results for each."""
    parser = argparse.ArgumentParser(description="Measure how many throws arms from files block.")
    parser.add_argument("files", nargs="+", metavar="FILE")
    parser.add_argument("--tip")
    parser.add_argument("--limits")
    parser.add_argument("--mass", type=float, default=0.0)
    parser.add_argument("--wide", action="store_true")
    parser.add_argument("--num", type=int, default=200)
    parser.add_argument("--seed", type=int, default=977)
    parser.add_argument("--suite", default="open")
    parser.add_argument("--long", action="store_true")
    options = parser.parse_args()
    print("| arm | joints | blocked | first plan, again [s] | of those a long search blocks |")
    print("|---|---|---|---|---|")
    for file in options.files:
        print(_row(file, options), flush=True)


def _row(file: str, options: argparse.Namespace) -> str:
    if file == "irb1600":
        arm = irb1600()
    else:
        own = {"tip": options.tip, "limits": options.limits}
        arm = pj.block.read_arm(file, shield=pj.block.Shield(mass=options.mass), **own)
    draw = {"arm": arm, "wide": options.wide}
    cases = pj.block.draw(options.num, options.suite, options.seed, **draw)
    planner, starts = pj.block.planner(), [time.perf_counter()]
    pj.plan(planner, cases)
    starts.append(time.perf_counter())
    plans = pj.plan(planner, cases)
    seconds = np.diff([*starts, time.perf_counter()])
    success = np.asarray(pj.block.judge(cases, plans).success)
    share = "-"
    if options.long:
        search = Search(straight=0, starts=_STARTS, tries=_STARTS, kept=_STARTS, in_turn=False)
        failed = np.flatnonzero(~success)
        union = success.copy()
        if failed.size:
            left = pj.take(cases, failed)
            longer = pj.plan(pj.block.planner(searches=(search,)), left)
            union[failed] = np.asarray(pj.block.judge(left, longer).success)
        share = f"{success.sum()} of {union.sum()}, {success.sum() / union.sum():.1%}"
    return (
        f"| {file.rsplit('/', 1)[-1]} | {arm.num} | {success.mean():.1%} | "
        f"{seconds[0]:.1f}, {seconds[1]:.2f} | {share} |"
    )


if __name__ == "__main__":
    main()
