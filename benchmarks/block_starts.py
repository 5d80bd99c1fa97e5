"""Learn the starting points of the block planner's search by least squares.

    python -m benchmarks.block_starts [--num 60] [--tries 24] [--lanes 512] [--write] [--out DIR]

The planner first tries straight motions of the arm, in which all joints move in proportion. If none
of them blocks the ball, it searches by least squares. The search starts from a straight motion plus
a bump: each joint deviates smoothly to one side, by a given angle in the middle of the motion. The
planner sorts the end poses in which the shield meets the ball. A starting point consists of the
rank of the end pose in this order, and of a bump.

Throws are drawn from the suite `pole` with seed 1001 and R2, a set of joint limits. They are met at
a right angle, and the arm may start after 0.05 s. No reported result uses these throws. Throws that
no straight motion blocks are planned from random starting points. Then there are two kinds of
candidates for the bumps: random bumps that led to plans, and typical deviations of these plans from
straight motions. Each candidate is tried with the first ten end poses, on all throws for which a
plan was found. The starting points are selected greedily: of the throws that no selected point
blocks yet, the next selected point blocks the largest number.

--write replaces the file that the library ships. The shipped file was learned with the options
--num 2400 --tries 384 --lanes 16384, in half a minute on one H200.
"""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from scipy.cluster.vq import kmeans2

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin
from planner_jax.core.protocol import is_solved
from planner_jax.optimise.levenberg import least_squares
from planner_jax.robot.arm_motion import angles_at, bump_steps
from planner_jax.task.block.default_planner import OnlineBlock
from planner_jax.task.block.plan import BlockPlan
from planner_jax.task.block.problem.end_poses import all_profiles, end_poses
from planner_jax.task.block.problem.flight import flight_of
from planner_jax.task.block.search import attempts
from planner_jax.task.block.search.least_squares import rank_poses

SEED, DELAY = 1001, 0.05  # Seed of the throws, and time [s] after which the arm may start.
STRAIGHT = 32  # Number of straight motions that are tried for each throw.
SPREAD = np.array([0.5, 0.4, 0.4, 0.3, 0.5, 0.0])  # [rad] Typical size of each joint's random bump.
RANKS, LATER_RANKS = 10, 24  # Numbers of end poses for candidates, and for random starting points.
KINDS = 48  # Number of random bumps among the candidates; there are 48 typical deviations, too.
MOST = 16  # Maximum number of selected starting points.
SHARES = tuple(np.arange(1, 33) / 32)  # Sampled times of a motion, divided by its duration.


def random_starts(rng: np.random.Generator, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw `num` initial motions from which a least-squares search of block motions starts.

    An initial motion is a straight motion, in which all joints move in proportion to an end pose,
    plus a bump. Returns bumps (num, 6) [rad], the greatest deviations of the joints from the
    straight motion, and ranks (num,) of end poses. The planner sorts the end poses of a throw; rank
    0 is its first choice.
    """
    bumps = rng.normal(size=(num, 6)) * SPREAD * rng.uniform(0.3, 1.8, (num, 1))
    return bumps, rng.integers(0, LATER_RANKS, num)


@struct.dataclass
class Followed:
    """Result of a least-squares search of a block motion from one initial motion of the arm."""

    plan: BlockPlan
    point: Array  # (n,), the planner's unknowns at the end of the search
    profile: Array  # () int, velocity profile of the initial motion, an index into `all_profiles`


def follow(
    planner: OnlineBlock,
    case: pj.block.BlockCase,
    bump: Array,
    rank: Array,
    steps: int | Array,
) -> Followed:
    """Search a block motion by least squares for one case, from a straight motion plus a bump.

    In a straight motion all joints move in proportion. The search runs to its end, even where the
    planner would stop it because success is unlikely.

    Args:
        planner: defines the unknowns and residuals.
        case: one case.
        bump: (6,) [rad], greatest deviation of each joint from the straight motion.
        rank: () int < 24, index of the motion's end pose in the planner's order of end poses.
        steps: maximum number of least-squares steps; a number, or () int.
    """
    flight = flight_of(case)
    poses = end_poses(case, flight, planner.points, planner.pieces)
    place = rank_poses(poses, LATER_RANKS, 1.0 - planner.slack)[rank]
    start = planner.encode_straight(case, poses, place)
    start = start.at[:-1].add(bump_steps(bump, planner.pieces).reshape(-1))
    solver = dataclasses.replace(planner.attempts[0].solver, max_steps=steps, hope=None)
    end = least_squares(lambda point: planner.model(point, case, flight), start, solver)
    plan = planner.finish(case, flight, end.point, end.steps)
    return Followed(plan, end.point, poses.profile[place])


@jax.jit
def try_starts(
    planner: OnlineBlock, cases: pj.block.BlockCase, bumps: Array, ranks: Array, steps: Array
) -> tuple[Array, Array]:
    """Search block motions by least squares for B cases, each from one initial motion.

    An initial motion is a straight motion, in which all joints move in proportion, plus a bump.

    Args:
        planner: defines the unknowns and residuals.
        cases: B cases.
        bumps: (B, 6) [rad], greatest deviation of each joint from the straight motion.
        ranks: (B,) int, indices of end poses in the planner's order.
        steps: () int, maximum number of least-squares steps.

    Returns:
        is_good: (B,) bool, whether the plan is solved.
        found: (B, 6) [rad], bump that best fits the deviation of the planned motion from the
            straight motion to the same end pose.
    """

    def one(case: pj.block.BlockCase, bump: Array, rank: Array) -> tuple[Array, Array]:
        end = follow(planner, case, bump, rank, steps)
        moves, first, _ = planner.decode(case, end.point)
        angles = angles_at(case.angles, first, moves, SHARES)
        shape = jnp.asarray(all_profiles(planner.pieces)[0], angles.dtype)[end.profile]
        straight = shape[:, None] * (angles[-1] - case.angles)
        beside = angles - angles_at(case.angles, first, straight, SHARES)
        weight = jnp.asarray(np.sin(np.pi * np.array(SHARES)) ** 2, angles.dtype)
        return is_solved(end.plan.status), jnp.sum(beside * weight[:, None], axis=0) / jnp.sum(
            weight**2
        )

    return jax.vmap(one)(cases, bumps, ranks)


def try_in_parts(
    cases: Any, index: np.ndarray, bumps: np.ndarray, ranks: np.ndarray, steps: int, lanes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Search block motions by least squares from N initial motions, `lanes` of them in one call.

    An initial motion is a straight motion, in which all joints move in proportion, plus a bump.

    Args:
        cases: a batch of cases.
        index: (N,) int, index of the case of each initial motion.
        bumps: (N, 6) [rad], greatest deviation of each joint from the straight motion.
        ranks: (N,) int, indices of end poses in the planner's order.
        steps: maximum number of least-squares steps.
        lanes: number of searches in one call of the compiled program.

    Returns:
        Whether each search led to a plan (N,), and the greatest deviations of the joints from a
            straight motion in the results (N, 6) [rad].
    """

    def parts() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for first in range(0, len(index), lanes):
            here = np.arange(first, min(first + lanes, len(index)))
            full = np.resize(here, lanes)
            given = (jnp.asarray(bumps[full], jnp.float32), jnp.asarray(ranks[full]))
            some = pj.take(cases, index[full])
            good, beside = try_starts(OnlineBlock(), some, *given, jnp.asarray(steps))
            yield np.asarray(good)[: len(here)], np.asarray(beside)[: len(here)]

    good, beside = zip(*parts(), strict=True)
    return np.concatenate(good), np.concatenate(beside)


def select_starts(solves: np.ndarray) -> list[int]:
    """Select greedily from which initial motions the planner of blocks starts its search.

    Entry (throw, motion) of the table `solves` (throws, motions) bool is true if a search from the
    initial motion blocks the throw. Of the throws that no selected motion blocks yet, the next
    selected motion blocks the largest number. Returns at most 16 column indices.
    """
    left, chosen = np.ones(len(solves), bool), []
    while left.any() and len(chosen) < MOST:
        gain = solves[left].sum(axis=0)
        best = int(np.lexsort((solves.sum(axis=0), gain))[-1])
        if not gain[best]:
            break
        chosen.append(best)
        left &= ~solves[:, best]
    return chosen


def learn(bench: Bench, num: int, tries: int, lanes: int) -> list[dict[str, Any]]:
    """Draw throws, and learn initial motions for the planner's search of blocks by least squares.

    An initial motion is a straight motion, in which all joints move in proportion, plus a bump.
    Returns the rank of the straight motion's end pose and the bump of each initial motion, in the
    order in which the planner tries them.

    Args:
        bench: prints the share of solved throws.
        num: number of throws.
        tries: number of random initial motions for each throw.
        lanes: number of searches that run in one call.
    """
    rng = np.random.default_rng(0)
    cases = pj.block.draw(num, "pole", SEED, regime="R2", delay=DELAY)
    places, none = np.repeat(np.arange(num), STRAIGHT), np.zeros((num * STRAIGHT, 6))
    ranks = np.tile(np.arange(STRAIGHT), num)
    straight = try_in_parts(cases, places, none, ranks, -1, lanes)[0].reshape(num, -1).any(axis=1)
    hard = np.flatnonzero(~straight)
    bench.say(f"{100 * straight.mean():.1f} % of {num} throws by straight motions")

    bumps, ranks = random_starts(rng, len(hard) * tries)
    places = np.repeat(hard, tries)
    good, beside = try_in_parts(cases, places, bumps, ranks, 20, lanes)
    solvable = hard[good.reshape(-1, tries).any(axis=1)]
    bench.say(
        f"{len(solvable)} of the {len(hard)} others from one of {tries} random starts; one start "
        f"blocks {100 * good.mean():.1f} %"
    )

    if not solvable.size:
        return []

    some = [rng.permutation(np.flatnonzero(good & (places == throw)))[:8] for throw in solvable]
    picked = np.concatenate(some)
    # The initial cluster centres are drawn here, because the argument `seed` of `kmeans2` is
    # deprecated. With its argument `rng` the shipped file could not be reproduced.
    first = np.random.RandomState(1).choice(len(picked), min(KINDS, len(picked)), replace=False)
    middles, _ = kmeans2(beside[picked], beside[picked[first]], minit="matrix")
    candidates = np.concatenate([middles, bumps[rng.permutation(picked)[:KINDS]]])
    throw, kind, rank = np.meshgrid(
        solvable, np.arange(len(candidates)), np.arange(RANKS), indexing="ij"
    )
    solves, _ = try_in_parts(
        cases, throw.ravel(), candidates[kind.ravel()], rank.ravel(), 16, lanes
    )
    solves = solves.reshape(len(solvable), -1)
    chosen = select_starts(solves)
    for count in range(1, len(chosen) + 1):
        share = solves[:, chosen[:count]].any(axis=1).mean()
        bench.say(f"{count} starts: {100 * share:.1f} % of these")
    bench.count(solves[:, chosen].any(axis=1))
    return [
        {"rank": k % RANKS, "bump": [round(float(x), 3) for x in candidates[k // RANKS]]}
        for k in chosen
    ]


def main() -> None:
    parser = argument_parser("block_starts", __doc__, num=60, tries=24)
    parser.add_argument(
        "--lanes", type=at_least(1), default=512, help="starts optimised in one call"
    )
    parser.add_argument("--write", action="store_true", help="replace the shipped file")
    options = parser.parse_args()
    with begin(parser, options) as bench:
        starts = learn(bench, options.num, options.tries, options.lanes)
        if starts and options.write:
            path = Path(attempts.__file__).parent / "learned_starts.json"
            path.write_text(json.dumps(starts, indent=1) + "\n")
            bench.say(f"Written: {path.name}, {len(starts)} starts.")


if __name__ == "__main__":
    main()
