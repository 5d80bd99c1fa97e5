"""Search for home poses from which the arm blocks the largest share of balls.

    python -m benchmarks.block_home [--num 500] [--candidates 48] [--rounds 4] [--out DIR]

A home pose consists of the six joint angles at which the arm waits for a ball. The cross-entropy
method draws --candidates random poses in each round. In the first round they are uniform. In later
rounds they have a normal distribution around the best eighth of all poses so far. Poses in
collision, or within 3 cm of the pole in front of the arm, are left out.

The score of a pose is the share of the round's balls that a straight motion, in which all joints
move in proportion, blocks in time and without a collision. 48 straight motions are tried for each
ball. In the search the arm may start only 0.133 s after a ball is first seen. This makes blocking
harder, so that the scores of good and bad poses differ more.

The best poses of all rounds are compared on other balls. Finally the three best poses and the home
pose of [Natarajan2024] are compared on --num further balls. For this comparison the default planner
plans the motions, and the referee, an independent check in float64, judges them.
"""

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.robot.arm_clearance import clearances, num_of_obstacles
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_scene import paper_scene
from planner_jax.sweep.block.settings import REGIMES
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.search.attempts import Search

# [rad] Bounds between which the first round draws the six joint angles of a pose.
LOWEST = np.array([-0.8, -1.05, -2.0, -0.5, -1.9, -0.8])
HIGHEST = np.array([0.8, 1.5, 0.95, 0.5, 1.9, 0.8])
# [m] At home the arm must be farther than MARGIN from itself and from all obstacles, and farther
# than POLE_MARGIN from the pole in front of it.
MARGIN, POLE_MARGIN = 0.005, 0.03
ELITE = 8  # The best eighth of all poses defines the normal distribution of the next round.
LATE = 0.133  # [s] In the search the arm may start this long after the ball is first seen.
REPORTED = 3  # Number of home poses found by the search that the printed table contains.
DELAYS = (0.0, 0.133)  # [s] In the printed table the arm may start at each of these times.
STRAIGHT = OnlineBlock(searches=(Search(straight=48, tries=0),))


def from_home(cases: Any, homes: np.ndarray) -> Any:
    num = len(homes)

    def repeat(leaf: Any) -> np.ndarray:
        leaf = np.asarray(leaf)
        return np.tile(leaf, (num,) + (1,) * (leaf.ndim - 1))

    all_cases = jax.tree.map(repeat, cases)
    angles = np.repeat(homes, cases.batch_shape[0], axis=0).astype(all_cases.angles.dtype)
    arm = dataclasses.replace(all_cases.arm, home=angles)
    return dataclasses.replace(all_cases, angles=angles, arm=arm)


def share_solved(planner: Any, cases: Any, homes: np.ndarray) -> np.ndarray:
    plans = pj.plan(planner, from_home(cases, homes))
    return pj.are_solved(plans).reshape(len(homes), -1).mean(axis=1)


def draw_candidates(random: np.random.Generator, num: int, around: np.ndarray | None) -> np.ndarray:
    """Draw `num` random poses of the arm, joint angles (num, 6) [rad], without a collision.

    The angles are uniform between fixed bounds if `around` is None. Otherwise they are normal, with
    the mean and standard deviation of the poses `around` (E, 6) [rad].
    """
    arm, scene = irb1600(), paper_scene()

    @jax.jit
    def is_free(angles: jax.Array) -> jax.Array:
        gaps, of_pole = clearances(arm, scene, angles), num_of_obstacles(arm, scene)
        near_pole = jnp.min(gaps[:of_pole], axis=0) < POLE_MARGIN
        return (jnp.min(gaps, axis=0) > MARGIN) & ~near_pole

    found = np.zeros((0, 6))
    while len(found) < num:
        if around is None:
            some = random.uniform(LOWEST, HIGHEST, (8 * num, 6))
        else:
            spread = np.std(around, axis=0) + 0.02
            some = random.normal(np.mean(around, axis=0), spread, (8 * num, 6))
        some = np.clip(some, arm.lower, arm.upper)
        found = np.concatenate([found, some[np.asarray(is_free(some))]])
    return found[:num]


def main() -> None:
    parser = argument_parser(
        "block_home", __doc__, num=500, seed=7, candidates=48, rounds=4, throws=96
    )
    parser.add_argument("--regime", choices=REGIMES, default="R2", help="default: R2")
    parser.add_argument(
        "--wide",
        action="store_true",
        help="balls may meet the shield off its middle and at an angle",
    )
    options = parser.parse_args()
    kind: dict[str, Any] = {"regime": options.regime, "wide": options.wide}

    def throws(num: int, which: int, delay: float) -> Any:
        return pj.block.draw(num, seed=options.seed + which, delay=delay, **kind)

    random = np.random.default_rng(options.seed)
    planner = pj.block.planner()
    with begin(parser, options) as bench:
        homes, worth = np.zeros((0, 6)), np.zeros(0)
        elites = None
        for k in range(options.rounds):
            began = time.perf_counter()
            new = draw_candidates(random, options.candidates, elites)
            rates = share_solved(STRAIGHT, throws(options.throws, k + 1, LATE), new)
            homes, worth = np.concatenate([homes, new]), np.concatenate([worth, rates])
            best = np.argsort(-worth)[: max(options.candidates // ELITE, 2)]
            elites = homes[best]
            bench.say(
                f"round {k + 1}: {options.candidates} homes x {options.throws} throws, straight: "
                f"median {100 * np.median(rates):.1f} %, best {100 * rates.max():.1f} % "
                f"({time.perf_counter() - began:.0f} s)"
            )
            bench.row(round=k + 1, rates=rates, homes=new)
        finalists = homes[np.argsort(-worth)[: 2 * ELITE]]
        again = share_solved(
            STRAIGHT, throws(4 * options.throws, options.rounds + 1, LATE), finalists
        )
        chosen = finalists[np.argsort(-again)[:REPORTED]]
        authors = np.asarray(irb1600().home, float)[None]
        bench.say(
            "",
            f"{options.num} other throws, {options.regime}, "
            f"{'wide' if options.wide else 'strict'}; angles [rad]",
            "",
            "| home | start after | blocked | straight motions alone | solved, rejected |",
            "|---|---|---|---|---|",
        )
        home_poses = {"the authors'": authors[0]}
        home_poses |= {f"found, rank {k + 1}": home for k, home in enumerate(chosen)}
        for name, home in home_poses.items():
            for delay in DELAYS:
                cases = from_home(throws(options.num, 1000, delay), home[None])
                plans = pj.plan(planner, cases)
                success = pj.block.judge(cases, plans).success
                straight = success & (np.asarray(plans.iterations) == 0)
                refused = (pj.are_solved(plans) & ~success).sum()
                bench.say(
                    f"| {name} ({', '.join(f'{angle:.3f}' for angle in home)}) | {delay:g} s "
                    f"| {100 * success.mean():.1f} % | {100 * straight.mean():.1f} % | {refused} |"
                )
                bench.row(home=name, angles=home, delay=delay, blocked=success.mean())
                if name == "found, rank 1" and delay == 0.0:
                    bench.count(success)


if __name__ == "__main__":
    main()
