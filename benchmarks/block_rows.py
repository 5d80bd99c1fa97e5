"""Measure how many throws a block planner blocks, beside other methods on the same throws.

    python -m benchmarks.block_rows [--num 2000] [--seed 7] [--rows "R2,R2 late"] [--starts 192]
        [--lanes N] [--planner online] [--write] [--out DIR]

A robot arm blocks thrown balls with a shield. Each row of the table has a suite of throws, joint
limits, and a time at which the arm may start. The time for planning is ignored. A straight motion
is a motion in which all joints move in proportion. Columns are in percent of all throws:
* end pose: some straight motion ends in time at a pose of the shield that meets the ball. The pose
  is free of collision, but the path to it need not be. This is nearly an upper bound. It is not
  exact, because only a finite set of poses is searched;
* straight: a straight motion blocks the ball, and is free of collision on its whole path;
* planner: the planner --planner blocks the ball;
* long: a long search blocks the ball, but neither a straight motion nor the planner does. The long
  search is least squares from --starts random starts, 40 steps each, without early stopping;
* union: a straight motion, the planner or the long search blocks the ball;
* planner of union: blocks of the planner, divided by the blocks of the union.

In all columns but "end pose" the referee, an independent check in float64, decides whether a ball
is blocked. --write stores the throws and the results in `block_throws.csv` beside this file, one
line a throw. The column of each method has one digit for every row of the table that uses the
throw, in the order stated at the top of the file; 1 means blocked. Read the columns of methods as
text, because their values may begin with zeros.
"""

import csv
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import planner_jax as pj
from planner_jax.benchmarks.block_starts import follow, random_starts
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin, parse_names
from planner_jax.robot.arm_clearance import least_clearances
from planner_jax.runs.summary import wilson_interval
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.problem.end_poses import end_poses
from planner_jax.task.block.problem.flight import flight_of
from planner_jax.task.block.search.attempts import Search

# [s] In rows named "late" the arm may start only this long after the ball is first seen.
LATE = 0.133
# Row of the printed table -> suite of throws, and options of `pj.block.draw`. R1 and R2 are sets of
# joint limits. In rows named "wide" the ball may meet the shield off its centre and at a slant.
ROWS: dict[str, tuple[str, dict[str, Any]]] = {
    "R1": ("pole", {"regime": "R1"}),
    "R1 late": ("pole", {"regime": "R1", "delay": LATE}),
    "R1 wide": ("pole", {"regime": "R1", "wide": True}),
    "R2": ("pole", {}),
    "R2 late": ("pole", {"delay": LATE}),
    "R2 wide": ("pole", {"wide": True}),
    "R2 wide late": ("pole", {"wide": True, "delay": LATE}),
    "short R2 wide late": ("short", {"wide": True, "delay": LATE}),
    "open R1": ("open", {"regime": "R1"}),
    "open R2": ("open", {}),
    "open R2 late": ("open", {"delay": LATE}),
}
METHODS = ("end pose", "straight", "planner", "long", "union")
STEPS = 40  # Number of least-squares steps from each start of the long search.
STRAIGHT = OnlineBlock(searches=(Search(tries=0),))


@jax.jit
@jax.vmap
def has_end_pose(case: pj.block.BlockCase) -> Array:
    """Return whether a straight motion ends in time at a pose that blocks the ball, () bool.

    In a straight motion all joints move in proportion, within their limits. The pose must be free
    of collision; collisions on the path to it are ignored.
    """
    poses = end_poses(case, flight_of(case), STRAIGHT.points, STRAIGHT.pieces)
    gaps = least_clearances(case.arm, case.scene, poses.angles)
    inside = (poses.angles >= case.arm.lower) & (poses.angles <= case.arm.upper)
    return jnp.any((poses.effort <= 1.0) & (gaps > 0.0) & jnp.all(inside, axis=1))


@jax.jit
def long_search(cases: pj.block.BlockCase, bumps: Array, ranks: Array) -> pj.block.BlockPlan:
    """Plan each of B cases by least squares from N starts; return the best plan of each case.

    The best plan is the plan that exceeds the limits by the least amount. Start n is a straight
    motion, in which all joints move in proportion, plus a smooth deviation of the joints by up to
    `bumps[n]` (6,) [rad]. The planner sorts the poses in which the shield meets the ball, and the
    straight motion ends at the pose with rank `ranks[n]` in this order.
    """
    online = OnlineBlock()

    def of_case(case: pj.block.BlockCase) -> pj.block.BlockPlan:
        def of_start(bump: Array, rank: Array) -> pj.block.BlockPlan:
            return follow(online, case, bump, rank, STEPS).plan

        plans = jax.vmap(of_start)(bumps, ranks)
        excess = jnp.where(jnp.isnan(plans.violation), jnp.inf, plans.violation)
        return jax.tree.map(lambda leaf: leaf[jnp.argmin(excess)], plans)

    return jax.vmap(of_case)(cases)


def search_long(cases: pj.block.BlockCase, index: np.ndarray, starts: int, lanes: int) -> Any:
    """Return which of N cases are blocked by a long search from random starts, (N,) bool.

    The referee, an independent check, judges the plans.

    Args:
        cases: a batch that contains the N cases.
        index: (N,) int, indices of the N cases in the batch.
        starts: number of random starts for each case.
        lanes: number of starts that are optimised in one call.
    """
    bumps, ranks = random_starts(np.random.default_rng(2), starts)
    given = jnp.asarray(bumps, jnp.float32), jnp.asarray(ranks)
    size, found = max(1, lanes // starts), []
    for first in range(0, len(index), size):
        here = index[first : first + size]
        some = pj.take(cases, np.resize(here, size))
        plans = jax.device_get(long_search(some, *given))
        good = pj.block.judge(some, plans).success & pj.are_solved(plans)
        found.append(good[: len(here)])
    return np.concatenate([np.zeros(0, bool), *found])


def find_blocked(cases: pj.block.BlockCase, planner: Any) -> np.ndarray:
    plans = pj.plan(planner, cases)
    return np.asarray(pj.block.judge(cases, plans).success & pj.are_solved(plans))


def measure(bench: Bench, name: str, options: Any) -> dict[str, np.ndarray]:
    """Draw throws, and print the share of them that each method of planning a block blocks.

    `name` is a row of the table, such as "R2 late": the joint limits R2 of the arm, which may start
    late. `options` are the command-line options. Returns for each method, by name, which of the N
    throws it blocks, (N,) bool.
    """
    suite, settings = ROWS[name]
    cases = pj.block.draw(options.num, suite, options.seed, **settings)
    found = {
        "end pose": np.asarray(has_end_pose(cases)),
        "straight": find_blocked(cases, STRAIGHT),
        "planner": find_blocked(cases, pj.block.planner(options.planner)),
    }
    left = np.flatnonzero(~(found["straight"] | found["planner"]))
    found["long"] = np.zeros(options.num, bool)
    found["long"][left] = search_long(cases, left, options.starts, options.lanes)
    found["union"] = found["straight"] | found["planner"] | found["long"]
    share = found["planner"].sum() / max(1, found["union"].sum())
    low, high = wilson_interval(int(found["planner"].sum()), options.num)
    rates = " | ".join(f"{100 * found[method].mean():.2f}" for method in METHODS)
    bench.say(f"| {name} | {rates} | {100 * share:.1f} | {100 * low:.1f} to {100 * high:.1f} |")
    bench.row(row=name, share=share, **{method: int(found[method].sum()) for method in METHODS})
    bench.count(found["planner"])
    return found


def write_throws(path: Path, results: dict[str, dict[str, np.ndarray]], options: Any) -> None:
    """Write a CSV file with each throw's position and velocity, and which methods block it.

    A throw is used in several rows of the printed table, which differ in limits. The column of a
    method has one digit for each of these rows: 1 if the method blocks the throw, 0 if not.
    """
    suites = {ROWS[name][0]: [] for name in results}
    for name in results:
        suites[ROWS[name][0]].append(name)
    with path.open("w", newline="") as file:
        for suite, names in suites.items():
            file.write(f"# {suite}: a digit each for {', '.join(names)}\n")
        writer = csv.writer(file, lineterminator="\n")
        place = ("x [m]", "y [m]", "z [m]", "vx [m/s]", "vy [m/s]", "vz [m/s]")
        writer.writerow(["suite", "throw", *place, *METHODS])
        for suite, names in suites.items():
            balls = pj.block.draw(options.num, suite, options.seed).ball
            states = np.concatenate([balls.pos, balls.vel], axis=1)
            for throw, state in enumerate(states):
                marks = (
                    "".join("01"[int(results[name][method][throw])] for name in names)
                    for method in METHODS
                )
                numbers = (f"{number:.6g}" for number in state)
                writer.writerow([suite, throw, *numbers, *marks])


def main() -> None:
    parser = argument_parser("block_rows", __doc__, num=2000, seed=7, starts=192)
    parser.add_argument(
        "--rows", default=",".join(ROWS), help=f"rows to print, of {', '.join(ROWS)}; default: all"
    )
    parser.add_argument(
        "--lanes", type=at_least(1), default=192, help="starts optimised in one call"
    )
    parser.add_argument("--planner", default="online", help="planner to measure; default: online")
    parser.add_argument(
        "--write", action="store_true", help="write throws and columns to block_throws.csv"
    )
    options = parser.parse_args()
    names = parse_names(parser, "--rows", options.rows, ROWS)
    with begin(parser, options) as bench:
        bench.say(
            f"| row | {' | '.join(METHODS)} | planner of union | planner, 95 % |",
            "|---" * (len(METHODS) + 3) + "|",
        )
        results = {name: measure(bench, name, options) for name in names}
        if options.write:
            path = Path(__file__).with_name("block_throws.csv")
            write_throws(path, results, options)
            bench.say(f"Written: {path.name}.")


if __name__ == "__main__":
    main()
