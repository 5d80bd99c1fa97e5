"""Count throws that `pj.block.prospects` calls impossible although a planner blocks them.

    python -m benchmarks.block_prospects [--num 1000] [--seed 7] [--rows "R2 wide late"]
        [--planners online,online-best,brisk,direct,rrt-connect,epase,insat,long] [--starts 192]
        [--out DIR]

A robot arm blocks thrown balls with a shield. `pj.block.prospects` calls a throw impossible if no
pose of the arm meets the ball, if the arm touches something in all poses, or if the ball is too
early. Each planner plans the throws that are called impossible. A throw is contradicted if the
referee, an independent check in float64, accepts the plan, whatever status the plan has. The
planner `long` is the long search of `block_rows`, from --starts random starts. The rows are rows
of `block_rows`.
"""

from typing import Any

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.block_peers import PLANNERS, leave_out_missing
from planner_jax.benchmarks.block_rows import ROWS, search_long
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names

NAMES = ("online", "online-best", "brisk", "direct", "rrt-connect", "epase", "insat", "long")
_LANES = 192  # number of starts of the long search that are optimised in one call


def find_contradicted(name: str, cases: Any, index: np.ndarray, starts: int) -> np.ndarray:
    """Return which of N cases a planner blocks by the verdict of the referee, (N,) bool.

    Args:
        name: name of the planner.
        cases: a batch that contains the N cases.
        index: (N,) int, indices of the N cases in the batch.
        starts: number of random starts of the long search.
    """
    if name == "long":
        return search_long(cases, index, starts, _LANES)
    kind, effort = ("online", "best") if name == "online-best" else (name, "feasible")
    some = pj.take(cases, index)
    plans = pj.plan(pj.block.planner(kind, effort=effort), some)
    return np.asarray(pj.block.judge(some, plans).success)


def measure(bench: Bench, row: str, names: list[str], options: Any) -> None:
    """Print for a row of throws how many are called impossible, and how many of them are blocked.

    `options` are the command-line options, and `names` are the planners.
    """
    suite, settings = ROWS[row]
    cases = jax.tree.map(np.asarray, pj.block.draw(options.num, suite, options.seed, **settings))
    found = [pj.block.prospects(pj.take(cases, k)) for k in range(options.num)]
    index = np.flatnonzero([each.is_impossible for each in found])
    blocked = {name: np.zeros(0, bool) for name in names}
    if index.size:
        blocked = {k: find_contradicted(k, cases, index, options.starts) for k in names}
    contradicted = np.any([*blocked.values()], axis=0)
    by_planner = " | ".join(str(int(each.sum())) for each in blocked.values())
    bench.say(f"| {row} | {options.num} | {index.size} | {contradicted.sum()} | {by_planner} |")
    bench.row(row=row, impossible=int(index.size), contradicted=int(contradicted.sum()))
    bench.count(~contradicted)


def main() -> None:
    parser = argument_parser("block_prospects", __doc__, num=1000, seed=7, starts=192)
    parser.add_argument("--rows", default="R2 wide late", help="default: R2 wide late")
    parser.add_argument("--planners", default=",".join(NAMES), help="default: all")
    options = parser.parse_args()
    rows = parse_names(parser, "--rows", options.rows, ROWS)
    names = parse_names(parser, "--planners", options.planners, NAMES)
    with begin(parser, options) as bench:
        peers = leave_out_missing(bench, [name for name in names if name in PLANNERS])
        names = [name for name in names if name in peers or name not in PLANNERS]
        bench.say(
            f"| row | throws | called impossible | contradicted | {' | '.join(names)} |",
            "|---" * (len(names) + 4) + "|",
        )
        for row in rows:
            measure(bench, row, names, options)


if __name__ == "__main__":
    main()
