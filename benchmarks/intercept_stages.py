"""Measure each stage of the planner `paper` [Qu2022, Table III]: its time, and the cases it loses.

    python -m benchmarks.intercept_stages [--suite qu-map] [--num 60] [--pieces 20] [--out DIR]

The stages are the prediction of the target from 15 observations by a polynomial of degree 2; the
path by Hybrid A* on 80 x 80 cells of 0.1 m and its smoothing; and the speed along the path by
dynamic programming and a quadratic program. The plan meets the case's target, not the predicted
one, whose mean error at the meeting is printed. Times are for one case at a time on one core, from
arrays to arrays, without compilation, which the last column has. The fastest of three runs of all
stages counts.

The second table has how many cases pass each stage: Hybrid A* finds a path, dynamic programming a
line between the moving obstacles in the graph of station and time, the quadratic program a curve,
and the referee accepts the drive. An accepted drive counts as passing all stages, also if the
program reports a small excess. The cases are own cases: [Qu2022] shows one map, states neither
limits nor numbers, and publishes no rate. The extra `baselines` is needed.
"""

import dataclasses
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.baselines.intercept.paper import PaperIntercept
from planner_jax.baselines.intercept.path import Path
from planner_jax.baselines.intercept.speed import plan_speed
from planner_jax.baselines.protocols import BY_ROW
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin
from planner_jax.core.protocol import is_solved
from planner_jax.sims.prediction.polynomial_fit import fit_polynomial
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.spec import SUITES

PARTS = ("prediction", "path", "speed", "total")
PASSED = ("path found", "line in the graph of station and time", "speed program", "refereed")


@dataclasses.dataclass(frozen=True)
class Stages:
    """The stages of a planner for one case each, compiled where they do not run on the host."""

    predict: Callable[[np.ndarray, InterceptCase], jax.Array]  # position (2,) [m] at the meeting
    search: Callable[[InterceptCase], tuple]
    smooth: Callable[..., Path]
    # Whether dynamic programming finds a line, and the quadratic program a curve.
    check: Callable[[InterceptCase, Path], tuple[jax.Array, jax.Array]]
    drive: Callable[[InterceptCase, Path], InterceptPlan]


def stages_of(planner: PaperIntercept, times: np.ndarray) -> Stages:
    """Return the stages of a planner, for observations at `times` (L,) [s]."""
    step, speed = planner.step, planner.step.speed
    assert speed is not None  # `paper` plans a speed

    def check(case: InterceptCase, path: Path) -> tuple[jax.Array, jax.Array]:
        found = plan_speed(step.problem(case, path), speed)
        return found.reference.found, is_solved(found.status)

    return Stages(
        predict=jax.jit(lambda seen, case: fit_polynomial(times, seen, 2).at(case.time).pos),
        search=planner.search_path,
        smooth=jax.jit(planner.path),
        check=jax.jit(check),
        drive=jax.jit(lambda case, path: step.drive(case, path, step.problem(case, path))),
    )


def run_stages(stages: Stages, case: InterceptCase, seen: np.ndarray) -> tuple[dict, tuple]:
    """Run all stages; return the seconds of each part, and prediction, path, plan and "found"."""
    ticks = [time.perf_counter()]
    predicted = jax.block_until_ready(stages.predict(seen, case))
    ticks.append(time.perf_counter())
    *searched, is_found = stages.search(case)
    path = jax.block_until_ready(stages.smooth(case, *searched))
    ticks.append(time.perf_counter())
    plan = jax.block_until_ready(stages.drive(case, path))
    ticks.append(time.perf_counter())
    seconds = dict(zip(PARTS, [*np.diff(ticks), ticks[-1] - ticks[0]], strict=True))
    return seconds, (predicted, path, plan, bool(is_found))


def count_passed(passed: np.ndarray) -> list[int]:
    """Return for S stages how many of B cases pass them and all stages before.

    `passed` (B, S) has whether each case passes each stage.
    """
    return np.logical_and.accumulate(passed, axis=1).sum(axis=0).tolist()


def run(bench: Bench, planner: PaperIntercept, suite: str, num: int, seed: int) -> None:
    """Run all stages for the cases of a suite, and print the tables of times and of losses."""
    cases = jax.tree.map(np.asarray, pj.intercept.draw(num, suite, seed))
    times, seen = pj.intercept.observe(cases, seed)
    seen = seen.astype(np.float32)
    stages = stages_of(planner, times.astype(np.float32))
    lanes = [jax.tree.map(jnp.asarray, pj.take(cases, k)) for k in range(num)]
    first, _ = run_stages(stages, lanes[0], seen[0])
    seconds, passed, plans, errors = [], [], [], []
    for lane, positions in zip(lanes, seen, strict=True):
        runs = [run_stages(stages, lane, positions) for _ in range(3)]
        fastest, found = min(runs, key=lambda one: one[0]["total"])
        seconds.append(list(fastest.values()))
        predicted, path, plan, is_found = found
        errors.append(np.linalg.norm(predicted - lane.target.at(lane.time).pos))
        passed.append([is_found, *stages.check(lane, path)])
        plans.append(plan)
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *plans)
    accepted = pj.intercept.judge(cases, batch).success
    ms, order = 1e3 * np.array(seconds), ("mean", "p50", "p99")
    bench.say(
        f"mean error of the prediction at the meeting: {np.mean(errors):.2f} m",
        "",
        "| stage | mean [ms] | p50 [ms] | p99 [ms] | [Qu2022, Table III], mean | first call [s] |",
        "|---|---|---|---|---|---|",
    )
    for column, part in zip(ms.T, PARTS, strict=True):
        figures = dict(zip(order, (column.mean(), *np.percentile(column, [50, 99])), strict=True))
        cells = " | ".join(f"{value:.2f}" for value in figures.values())
        published = BY_ROW["Qu2022", "Table III", part]
        bench.say(f"| {part} | {cells} | {published} | {first[part]:.1f} |")
        bench.row(table="times", stage=part, **figures, first_call=first[part])
    counts = [num, *count_passed(np.column_stack([passed, accepted]) | accepted[:, None])]
    bench.say("", "| stage | cases | lost here |", "|---|---|---|", f"| all cases | {num} | - |")
    for name, before, after in zip(PASSED, counts, counts[1:], strict=False):
        bench.say(f"| {name} | {after} | {before - after} |")
        bench.row(table="losses", stage=name, cases=after, lost=before - after)
    bench.count(accepted, None)


def main() -> None:
    parser = argument_parser("intercept_stages", __doc__, num=60, seed=0)
    parser.add_argument("--suite", choices=list(SUITES), default="qu-map", help="default: qu-map")
    parser.add_argument("--pieces", type=at_least(2), help="of the speed; default: the planner's")
    options = parser.parse_args()
    planner: Any = pj.intercept.planner("paper")
    if options.pieces is not None:
        speed = dataclasses.replace(planner.step.speed, pieces=options.pieces)
        planner = dataclasses.replace(planner, step=dataclasses.replace(planner.step, speed=speed))
    with begin(parser, options) as bench:
        bench.say(
            f"{options.num} own cases of suite {options.suite}, seed {options.seed}, "
            f"{planner.step.speed.pieces} pieces, jax {jax.__version__}, load average "
            f"{os.getloadavg()[0]:.1f}"
        )
        run(bench, planner, options.suite, options.num, options.seed)


if __name__ == "__main__":
    main()
