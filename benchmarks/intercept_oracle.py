"""Measure which interceptions of a suite are feasible, and how early their targets can be met.

    python -m benchmarks.intercept_oracle [--suite hard] [--num 200] [--seed 1] [--first 0]
        [--planner spacetime] [--failed | --early] [--steering N] [--workers N] [--out FILE.npz]

A car must meet a moving target among obstacles. Three searches determine for each case whether the
target can be met at the case's time. They divide time into layers of 0.25 s, and also find the
first layer at which the target can be met. They share no code with the planners:

* `strict`: an exhaustive search of pose and speed on a lattice (`intercept_lattice`), with two
  discs that cover the car's body. A motion that it finds is feasible except for discretisation
  errors: a cell has a side of 0.05 m, headings are 5.6 degrees apart, obstacles are checked every
  0.125 s, and the steering rate is ignored. Cars on the lattice turn instantly, so they may leave
  starts that no real car can leave. Therefore a second search without a grid and with a limited
  steering rate (`intercept_departure`) must also find a motion away from the start.
* `minimal`: the same lattice with one disc inside of the body, and with turns rounded up in every
  layer. Except for rounding to cells, it reaches every target that a car can reach. Rounding may
  both close and open gaps. A target that this search does not reach is therefore very likely
  infeasible, but this is no proof.
* `bound`: a point that moves in any direction, no faster than the car (`intercept_bound`). If this
  point cannot meet the target at the time of a layer, no car can. This is a proof.

In short, a case is infeasible if `bound` fails, and very likely infeasible if `minimal` fails. If
`strict` succeeds, the case is feasible except for discretisation errors. Cases in which `minimal`
succeeds and `strict` fails are undecided. Meetings are checked only at the times of layers. Both
searches on the lattice add half the diagonal of a cell to the case's tolerance.

The planner --planner plans the same cases. A case counts as feasible if `strict` succeeds or the
planner solves it. The planner's success rate is the share of feasible cases that it solves, judged
by the referee, an independent check in float64. With --failed only cases that the planner does not
solve are searched. This gives the same success rate in much less time. With --early the default
planner also plans to meet every target as early as possible, and its times are compared with the
earliest meetings of `strict`.

The cars of `strict` need no time to steer, so a motion that it finds may be infeasible. With
--steering the cases that `strict` reaches and the planner does not solve are searched again, with
the steering angle as a part of the state (`intercept_steering`). A motion that this search finds is
accepted by the referee, and proves that the planner failed. If the search finds none, the case is
very likely infeasible. As a check, the search also runs on the first N cases that the planner
solves. With --early, the search determines when the late plans could have met their targets, and is
checked at the times of the first N other plans.
"""

import argparse
import dataclasses
import multiprocessing
import os
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

import planner_jax as pj
from planner_jax.benchmarks.intercept_bound import earliest_bound
from planner_jax.benchmarks.intercept_departure import departs
from planner_jax.benchmarks.intercept_lattice import LAYER, MINIMAL, STRICT, Lattice, Scene
from planner_jax.benchmarks.intercept_steering import STEP, find_plan
from planner_jax.benchmarks.run import Bench, at_least
from planner_jax.plane.obstacles import Obstacles
from planner_jax.plane.target import PlanePath
from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.task.intercept.api import draw
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.spec import SUITES, TASK

SEARCHES = ("bound", "minimal", "strict")


def scenes(cases: InterceptCase, layer: float = LAYER) -> list[Scene]:
    """Convert cases to scenes: plain numbers, with the target's position at each time step.

    A time step is at most `layer` [s] long.
    """
    ends = np.asarray(cases.time, float)
    layers = np.maximum(np.ceil(ends / layer - 1e-6), 1).astype(int)
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


def search(scene: Scene) -> tuple[list[bool], list[float]]:
    """Run three searches that decide whether and when a car can meet the target of a scene.

    Each search returns whether the target is met at the time that the case prescribes, and the
    earliest meeting [s]:
    * `bound` replaces the car by a point. If the point fails, every car fails;
    * `minimal` moves a disc inside of the car's body over a grid of states. If it fails, the case
      is very likely infeasible;
    * `strict` moves discs that cover the body. If it succeeds, the case is feasible except for
      discretisation errors.
    """
    of_bound = earliest_bound(scene)
    minimal, strict = (Lattice(scene, rules).reach() for rules in (MINIMAL, STRICT))
    of_strict = (strict.at_end, strict.earliest) if departs(scene) else (False, np.inf)
    found = [of_bound, (minimal.at_end, minimal.earliest), of_strict]
    return [at_end for at_end, _ in found], [earliest for _, earliest in found]


def search_all(found: list[Scene], workers: int) -> tuple[np.ndarray, np.ndarray]:
    """Run three searches on each of B scenes, in `workers` processes.

    The searches are `bound`, whose failure proves that no car can meet the target; `minimal`, which
    may meet targets that no car can meet; and `strict`, which covers the car's whole body. Returns
    whether each search meets the target at the prescribed time (B, 3), and the earliest meetings
    (B, 3) [s].
    """

    def gather(results: Iterator) -> tuple[np.ndarray, np.ndarray]:
        pairs = list(tqdm(results, total=len(found), unit="case"))
        at_end, earliest = ([pair[k] for pair in pairs] for k in range(2))
        return np.reshape(at_end, (-1, len(SEARCHES))), np.reshape(earliest, (-1, len(SEARCHES)))

    if workers == 1:
        return gather(map(search, found))
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        return gather(pool.imap(search, found))


def format_indices(indices: np.ndarray) -> str:
    return ", ".join(map(str, indices)) or "none"


def report(bench: Bench, index: np.ndarray, at_end: np.ndarray, earliest: np.ndarray) -> None:
    """Print the results of three searches on B cases.

    The searches are `bound`, whose failure proves that no car can meet the target; `minimal`, which
    may meet targets that no car can meet; and `strict`, which covers the car's whole body. `at_end`
    (B, 3) bool states whether targets are met at the prescribed time. `earliest` (B, 3) [s] has the
    earliest meetings. `index` (B,) has the numbers of the cases in the suite.
    """
    bench.say(
        "| search | solved at the case's time | at any time up to it | earliest median | p95 "
        "| not at the case's time |",
        "|---|---|---|---|---|---|",
    )
    for k, name in enumerate(SEARCHES):
        median, late = np.quantile(earliest[:, k], (0.5, 0.95), method="higher")
        bench.say(
            f"| {name} | {100 * at_end[:, k].mean():.1f} % "
            f"| {100 * np.isfinite(earliest[:, k]).mean():.1f} % | {median:.2f} s | {late:.2f} s "
            f"| {format_indices(index[~at_end[:, k]])} |"
        )
        bench.note(
            **{
                f"{name}_at_end": at_end[:, k].mean(),
                f"{name}_earliest_median": median,
                f"{name}_earliest_p95": late,
            }
        )
    same = at_end[:, 1] == at_end[:, 2]
    both = np.isfinite(earliest).all(axis=1)
    gaps = np.diff(earliest[both], axis=1)
    bench.say(
        "",
        f"minimal and strict agree on {100 * same.mean():.1f} %; strict is later than minimal by "
        f"{gaps[:, 1].mean() if both.any() else np.nan:.2f} s, minimal later than the bound by "
        f"{gaps[:, 0].mean() if both.any() else np.nan:.2f} s (means over cases that all meet).",
    )
    bench.note(agreement=same.mean())


def compare(bench: Bench, index: np.ndarray, reached: np.ndarray, solved: np.ndarray) -> None:
    """Print the share of feasible cases that the planner solves.

    A case is feasible if the exhaustive search `strict` reaches its target (`reached`, (B,) bool),
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


def can_steer(cases: InterceptCase, which: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return for M cases whether a car with a limited steering rate can meet the target, (M,) bool.

    `which` (M,) has the indices of the cases, and `times` (M,) [s] the times of the meetings.
    """
    if not which.size:
        return np.zeros(0, bool)
    chosen = dataclasses.replace(jax.tree.map(np.asarray, pj.take(cases, which)), time=times)
    return np.array(
        [
            find_plan(jax.tree.map(lambda leaf, k=k: leaf[k], chosen), scene) is not None
            for k, scene in enumerate(tqdm(scenes(chosen, STEP), unit="case"))
        ]
    )


def report_steering(
    bench: Bench,
    cases: InterceptCase,
    first: int,
    open_cases: np.ndarray,
    solved: np.ndarray,
    num: int,
) -> None:
    """Print the share of the cases feasible with a limited steering rate that the planner solves.

    Of B cases, `solved` (B,) bool are solved by the planner, and the others with the indices
    `open_cases` are reached by the search `strict`, which ignores the steering rate. The search
    with this limit runs on the cases `open_cases`, and as a check on the first `num` solved cases.
    `first` is the number of the first case in the suite.
    """
    checked, times = np.flatnonzero(solved)[:num], np.asarray(cases.time, float)
    found = can_steer(cases, open_cases, times[open_cases])
    known = int(can_steer(cases, checked, times[checked]).sum())
    good, feasible = int(solved.sum()), int(solved.sum() + found.sum())
    low, high = wilson_interval(good, feasible)
    bench.say(
        "",
        f"With a limited steering rate: the planner solves {percent(good, feasible)} % of the "
        f"{feasible} feasible cases (95 % interval {100 * low:.1f} to {100 * high:.1f} %). "
        f"Feasible and not solved: {format_indices(first + open_cases[found])}. No motion found: "
        f"{format_indices(first + open_cases[~found])}. As a check, the search finds a motion in "
        f"{known} of {len(checked)} cases that the planner solves.",
    )
    bench.note(of_feasible_with_steering=good / max(feasible, 1), steering_check=known)


def report_early(bench: Bench, cases: InterceptCase, earliest: np.ndarray, num: int | None) -> None:
    """Plan B cases to meet the target as soon as possible, and print how early the plans are.

    `earliest` (B,) [s] has the earliest meetings of the exhaustive search `strict`, for comparison.
    If `num` is not None, later plans are compared with the search that has a limited steering rate,
    too. As a check, this search runs at the meeting times of the first `num` other plans.
    """
    plans = pj.plan(pj.intercept.planner(meet="early"), cases)
    solved = np.asarray(pj.intercept.judge(cases, plans).success)
    met = np.where(solved, plans.time, np.inf)
    reached = np.isfinite(earliest)
    soon = int((met <= earliest + LAYER)[reached].sum())
    bench.say(
        "",
        f"Planned to meet as early as possible: {percent(int(solved.sum()), len(met))} % solved, "
        f"median {np.median(met):.2f} s; at most {LAYER:g} s later than the strict lattice on "
        f"{percent(soon, int(reached.sum()))} % of the {reached.sum()} that the lattice reaches.",
    )
    bench.note(early_median=float(np.median(met)), early_share=soon / max(int(reached.sum()), 1))
    if num is None:
        return
    is_late, sooner = reached & (met > earliest + LAYER), np.full(len(met), np.inf)
    for k in np.flatnonzero(is_late):
        for at in np.arange(earliest[k], min(met[k], float(cases.time[k])) - LAYER, STEP):
            if can_steer(cases, np.array([k]), np.array([at]))[0]:
                sooner[k] = at
                break
    checked = np.flatnonzero(reached & ~is_late)[:num]
    known = int(can_steer(cases, checked, met[checked]).sum())
    soon = int((reached & np.isinf(sooner)).sum())
    bench.say(
        "",
        f"With a limited steering rate: {percent(soon, int(reached.sum()))} % of these plans meet "
        f"at most {LAYER:g} s after the earliest motion that was found. Later plans: "
        f"{format_indices(np.flatnonzero(np.isfinite(sooner)))}. As a check, the search finds a "
        f"motion at the times of {known} of {len(checked)} plans.",
    )
    bench.note(early_share_with_steering=soon / max(int(reached.sum()), 1), steering_check=known)


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
    add("--early", action="store_true", help="also plan to meet as early as possible")
    add(
        "--steering",
        type=at_least(0),
        metavar="N",
        help="also search with a limited steering rate, and check this search on N cases",
    )
    add(
        "--workers",
        type=at_least(1),
        default=os.cpu_count(),
        help="processes; default: one for each core",
    )
    add("--out", type=Path, help="an .npz file for the results of every case")
    options = parser.parse_args()
    if options.early and options.failed:
        parser.error("--early needs all cases, --failed searches only unsolved ones")
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
            bench.say("")
            report(bench, index, at_end, earliest)
        if options.early:
            report_early(bench, cases, earliest[:, SEARCHES.index("strict")], options.steering)
        reached = solved.copy()
        reached[searched] = at_end[:, SEARCHES.index("strict")]
        compare(bench, options.first + drawn, reached, solved)
        if options.steering is not None and not options.early:
            open_cases = np.flatnonzero(reached & ~solved)
            report_steering(bench, cases, options.first, open_cases, solved, options.steering)
        found: dict[str, np.ndarray] = {}
        found |= {f"{name}_at_end": at_end[:, k] for k, name in enumerate(SEARCHES)}
        found |= {f"{name}_earliest": earliest[:, k] for k, name in enumerate(SEARCHES)}
        times = np.asarray(cases.time, float)[searched]
        found |= {"suite": np.array(options.suite), "seed": np.array(options.seed)}
        found |= {"index": index, "time": times, "solved": solved[searched]}
        for path in [bench.path / "oracle.npz", *([options.out] if options.out else [])]:
            np.savez(path, allow_pickle=False, **found)


if __name__ == "__main__":
    main()
