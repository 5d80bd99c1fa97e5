"""Measure which interceptions of a suite are feasible, and how many of them a planner solves.

    python -m benchmarks.intercept_oracle [--suite hard] [--num 200] [--seed 1] [--first 0]
        [--planner spacetime] [--failed] [--workers N] [--out FILE.npz]

A car must meet a moving target among obstacles. A slow search determines for each case whether the
target can be met at the case's time. It divides time into layers of 0.25 s, and also finds the
first layer at which the target can be met. It shares no code with the planners. It consists of two
searches, which must both succeed:

* an exhaustive search of pose and speed on a lattice (`intercept_lattice`), with two discs that
  cover the car's body. A motion that it finds is feasible except for discretisation errors: a cell
  has a side of 0.05 m, headings are 5.6 degrees apart, obstacles are checked every 0.125 s, and the
  steering rate is ignored. Half the diagonal of a cell is added to the case's tolerance.
* a search without a grid and with a limited steering rate (`intercept_departure`), which must find
  a motion away from the start. Cars on the lattice turn instantly, so they may leave starts that no
  real car can leave.

The planner --planner plans the same cases. A case counts as feasible if the search succeeds or the
planner solves it. The planner's success rate is the share of feasible cases that it solves, judged
by the referee, an independent check in float64. With --failed only cases that the planner does not
solve are searched. This gives the same success rate in much less time.
"""

import argparse
import multiprocessing
import os
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

import planner_jax as pj
from planner_jax.benchmarks.intercept_departure import departs
from planner_jax.benchmarks.intercept_lattice import LAYER, Lattice, Scene
from planner_jax.benchmarks.run import Bench, at_least
from planner_jax.plane.obstacles import Obstacles
from planner_jax.plane.target import PlanePath
from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.task.intercept.api import draw
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.spec import SUITES, TASK


def scenes(cases: InterceptCase) -> list[Scene]:
    """Convert cases to scenes: plain numbers, with the target's position at each time step."""
    ends = np.asarray(cases.time, float)
    layers = np.maximum(np.ceil(ends / LAYER - 1e-6), 1).astype(int)
    times = ends[:, None] / layers[:, None] * np.arange(layers.max() + 1)
    with jax.enable_x64(True):
        cases = jax.tree.map(
            lambda leaf: np.asarray(leaf, bool if leaf.dtype == bool else float), cases
        )
        targets = np.asarray(_places(cases.target, times))
    found = []
    for k, (num, places) in enumerate(zip(layers, targets, strict=True)):
        one = jax.tree.map(lambda leaf, k=k: leaf[k], cases)
        movers, velocities = _polygons(one.movers)
        found.append(
            Scene(
                start=one.start,
                initial_speed=float(one.speed),
                initial_curvature=float(one.curvature),
                dt=float(ends[k] / num),
                target=places[: num + 1],
                tolerance=float(one.tolerance),
                end_heading=float(one.end_heading),
                heading_tolerance=float(one.heading_tolerance),
                walls=_polygons(one.walls)[0],
                movers=movers,
                velocities=velocities,
                lower=one.lower,
                upper=one.upper,
                length=float(one.body.length),
                width=float(one.body.width),
                middle=float(one.body.middle),
                wheelbase=float(one.body.wheelbase),
                speed=float(one.limits.speed),
                acceleration=float(one.limits.acceleration),
                lateral_acceleration=float(one.limits.lateral_acceleration),
                curvature=float(one.limits.curvature),
                steering_rate=float(one.limits.steering_rate),
            )
        )
    return found


@jax.jit
@jax.vmap
def _places(path: PlanePath, times: jax.Array) -> jax.Array:
    return jax.vmap(lambda time: path.at(time).pos)(times)


def _polygons(group: Obstacles) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Return the corners (V, 2) [m] of each of N obstacles, and their velocities (N, 2) [m/s].

    The entries of `group` that are not marked as present are placeholders, and are left out.
    """
    corners, present = group.vertices(0.0), np.asarray(group.present)
    return tuple(np.asarray(corners)[present]), np.asarray(group.velocity)[present]


def search(scene: Scene) -> tuple[bool, float]:
    """Search whether a car can meet the target of a scene, and how early.

    Returns whether the target is met at the time that the case prescribes, and the earliest meeting
    [s], or infinity.
    """
    found = Lattice(scene).reach()
    return (found.at_end, found.earliest) if departs(scene) else (False, np.inf)


def search_all(found: list[Scene], workers: int) -> tuple[np.ndarray, np.ndarray]:
    """Search each of B scenes, in `workers` processes.

    Returns whether the target is met at the prescribed time (B,), and the earliest meetings (B,)
    [s].
    """

    def gather(results: Iterator) -> tuple[np.ndarray, np.ndarray]:
        pairs = list(tqdm(results, total=len(found), unit="case"))
        return np.array([met for met, _ in pairs], bool), np.array([first for _, first in pairs])

    if workers == 1:
        return gather(map(search, found))
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        return gather(pool.imap(search, found))


def format_indices(indices: np.ndarray) -> str:
    return ", ".join(map(str, indices)) or "none"


def report(bench: Bench, index: np.ndarray, at_end: np.ndarray, earliest: np.ndarray) -> None:
    """Print the results of the search on B cases.

    `at_end` (B,) bool states whether targets are met at the prescribed time. `earliest` (B,) [s]
    has the earliest meetings. `index` (B,) has the numbers of the cases in the suite.
    """
    median, late = np.quantile(earliest, (0.5, 0.95), method="higher")
    bench.say(
        "",
        f"The search meets {percent(int(at_end.sum()), len(at_end))} % of the targets at the "
        f"case's time, and {percent(int(np.isfinite(earliest).sum()), len(at_end))} % at any time "
        f"up to it; earliest meetings: median {median:.2f} s, p95 {late:.2f} s. Not met at the "
        f"case's time: {format_indices(index[~at_end])}.",
    )
    bench.note(at_end=at_end.mean(), earliest_median=median, earliest_p95=late)


def compare(bench: Bench, index: np.ndarray, reached: np.ndarray, solved: np.ndarray) -> None:
    """Print the share of feasible cases that the planner solves.

    A case is feasible if the search reaches its target (`reached`, (B,) bool),
    or if the planner solves it (`solved`, (B,) bool). `index` (B,) has the numbers of the cases.
    """
    feasible = reached | solved
    good, num = int(solved.sum()), int(feasible.sum())
    low, high = wilson_interval(good, num)
    bench.say(
        "",
        f"The planner solves {percent(good, num)} % of the {num} feasible cases (95 % interval "
        f"{100 * low:.1f} to {100 * high:.1f} %), and {percent(good, len(index))} % of all. "
        f"Feasible and not solved: {format_indices(index[feasible & ~solved])}.",
    )
    bench.note(of_feasible=good / max(num, 1))
    bench.count(solved)


def main() -> None:
    parser = argparse.ArgumentParser(
        "python -m benchmarks.intercept_oracle", description=(__doc__ or "").partition("\n")[0]
    )
    add = parser.add_argument
    add("--suite", choices=SUITES, default="hard", help="default: hard")
    for name, least, default in (("num", 1, 200), ("seed", 0, 1), ("first", 0, 0)):
        add(f"--{name}", type=at_least(least), default=default, help=f"default: {default}")
    add("--planner", choices=TASK.planners, default="spacetime", help="default: spacetime")
    add("--failed", action="store_true", help="search only cases that the planner does not solve")
    add(
        "--workers",
        type=at_least(1),
        default=os.cpu_count(),
        help="processes; default: one for each core",
    )
    add("--out", type=Path, help="an .npz file for the results of every case")
    options = parser.parse_args()
    with Bench("intercept_oracle", vars(options)) as bench:
        cases = draw(options.num, options.suite, options.seed, first=options.first)
        plans = pj.plan(pj.intercept.planner(options.planner), cases)
        solved = np.asarray(pj.intercept.judge(cases, plans).success)
        drawn = np.arange(options.num)
        searched = drawn[~solved] if options.failed else drawn
        index = options.first + searched
        began = time.perf_counter()
        left = scenes(pj.take(cases, searched)) if searched.size else []
        at_end, earliest = search_all(left, options.workers)
        seconds = time.perf_counter() - began
        bench.say(
            f"{options.planner}, {options.suite}, seed {options.seed}, cases {options.first} to "
            f"{options.first + drawn[-1]}, {len(searched)} of them searched: "
            f"{seconds:.0f} s with {options.workers} processes"
        )
        if not options.failed:
            report(bench, index, at_end, earliest)
        reached = solved.copy()
        reached[searched] = at_end
        compare(bench, options.first + drawn, reached, solved)
        found: dict[str, np.ndarray] = {"at_end": at_end, "earliest": earliest}
        found |= {"suite": np.array(options.suite), "seed": np.array(options.seed)}
        times = np.asarray(cases.time, float)[searched]
        found |= {"index": index, "time": times, "solved": solved[searched]}
        for path in [bench.path / "oracle.npz", *([options.out] if options.out else [])]:
            np.savez(path, allow_pickle=False, **found)


if __name__ == "__main__":
    main()
