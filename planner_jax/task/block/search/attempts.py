"""Settings of the searches for a block, and the starting points of their least squares."""

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np

from planner_jax.core.compiled import with_run_time_numbers
from planner_jax.core.protocol import BaseAttempt
from planner_jax.optimise.levenberg import LevenbergConfig


@with_run_time_numbers("straight", "tries", "first", "kept", "in_turn", "detours")
@dataclasses.dataclass(frozen=True)
class Search(BaseAttempt):
    """An attempt: check some straight joint motions, then run least squares from several starts.

    There may be any number of starting points: 15 are stored, and further ones are drawn.
    """

    starts: int = 8
    straight: int = 48  # number of straight joint motions to check
    tries: int = 15  # number of starting points from which least squares are tried
    first: int = 0  # index of the first starting point to try
    kept: int = 5  # number of starting points that continue after the solver's trial steps
    # Whether each starting point is refined to its end before the next, if a single case is
    # planned. Otherwise all take a few trial steps first, and only the `kept` best ones continue.
    in_turn: bool = True
    # Number of further starting points: the best plan so far, with half of a stored detour added.
    # Searches of a batch on a GPU leave them out.
    detours: int = 0
    # `hope`: a starting point is abandoned if its cost after the trial steps is higher. Nearly all
    # starting points that lead to a valid plan have a lower cost.
    solver: LevenbergConfig = LevenbergConfig(
        *(26, 1e-2, 0.25, 6.0), settled=1, tolerance=1.0, trial=3, hope=1000.0, fade=0.7
    )


@with_run_time_numbers("straight")
@dataclasses.dataclass(frozen=True)
class StraightSearch(Search):
    """A search that only checks straight joint motions, without least squares (`tries` is 0)."""


_LEAST_SQUARES = (
    Search(straight=0, tries=4, kept=2),
    Search(straight=0, tries=11, first=4, kept=5, in_turn=False),
)
# Plans that are at most some 6 cm inside an obstacle are often mended by a longer search. It takes
# 0.1 s, so that only planners of higher effort make it.
LAST = Search(
    straight=0,
    detours=4,
    within=6.0,
    solver=dataclasses.replace(Search.solver, max_steps=40, fade=0.85),
)
SEARCHES = (Search(straight=12, tries=0), Search(tries=0), *_LEAST_SQUARES)


@functools.cache
def read_learned_starts(num: int = 0, joints: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Read the stored starting points, each a straight motion in joint space plus a detour.

    If there are fewer than `num`, further ones are drawn: the ranks in turn, and detours from the
    normal distribution with the stored detours' mean and standard deviation for each joint. The
    detours were learned for an arm of six joints, by `benchmarks.block_starts --num 2400 --tries
    384 --lanes 16384` of commit 340cc414. For an arm of seven joints, the additional joint is the
    third one, which turns the upper arm about its axis, and has no detour.

    Returns:
        ranks: (N,) int32, index of the motion's end pose among poses in order of rising effort.
        bumps: (N, n), detour of each joint [rad] at half of the motion's duration.
    """
    starts = json.loads((Path(__file__).parent / "learned_starts.json").read_text())
    ranks = np.array([start["rank"] for start in starts], np.int32)
    bumps = np.array([start["bump"] for start in starts], np.float32)
    more = max(num - len(starts), 0)
    drawn = np.random.default_rng(0).normal(size=(more, bumps.shape[1]))
    drawn = (bumps.mean(axis=0) + bumps.std(axis=0) * drawn).astype(np.float32)
    turns = (np.arange(more) % (1 + ranks.max())).astype(np.int32)
    every = np.insert(np.concatenate([bumps, drawn]), [2] * (joints - bumps.shape[1]), 0.0, axis=1)
    return np.append(ranks, turns), every


def settle_by(steps: int) -> dict[str, float]:
    """Return fields of a solver that continues at feasible points, for `steps` steps at most."""
    return {"max_steps": steps, "settled": 3, "tolerance": 2e-3}


def count_starts(searches: tuple[Search, ...]) -> int:
    """Return the number of starting points that any of the searches uses."""
    return max((search.first + search.tries for search in searches), default=0)
