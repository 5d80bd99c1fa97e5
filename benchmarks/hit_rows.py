"""Measure how often the planner of hits succeeds on every row of a published protocol.

    python -m benchmarks.hit_rows --serves DIR [--rows base,late-0.5] [--num N] [--out DIR]

A quadrotor hits a served ball with a racket such that it lands at a target [Yu2023bat]. The rows
are
* `base`: the quadrotor starts at the published initial position;
* `uniform-start`: the initial position is drawn over the half court;
* `late-T`: planning starts T seconds after the serve, while the quadrotor still hovers;
* `limits-F`: the limits on speed, acceleration and body rate are multiplied by F;
* `drag-after-impact`: the ball has drag also after the hit;
* `tight`, which is not part of the protocol: the limits are 2.5 m/s, 10 m/s^2 and 3 rad/s. In every
  hundredth case the ball flies away from the quadrotor, so that no plan can reach it.

The referee, an independent check in float64, decides about success. Without --serves the serves are
drawn with seed 0. The run folder also stores the indices of each row's failures.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.cost_gap import cost_gaps, gap_figures
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.runs.summary import wilson_interval
from planner_jax.task.hit.suites import Serves

ROWS: dict[str, dict] = {
    "base": {},
    "uniform-start": {"start": "uniform"},
    **{f"late-{delay}": {"delay": delay} for delay in (0.3, 0.5, 0.6, 0.8)},
    **{f"limits-{scale}": {"limit_scale": scale} for scale in (0.7, 0.5, 0.35)},
    "drag-after-impact": {},
    "tight": {},
}
_TIGHT = {"speed": 2.5, "acceleration": 10.0, "body_rate": 3.0}


def cases_of(name: str, serves: Serves) -> pj.hit.HitCase:
    """Convert serves to cases as the row `name` of the published protocol defines.

    For example, in `late-0.5` planning starts 0.5 s after the serve, in `limits-0.7` limits are
    multiplied by 0.7, and in `uniform-start` initial positions are random.
    """
    cases = pj.hit.to_cases(serves, **ROWS[name])
    if name != "tight":
        return cases
    vel = np.array(cases.ball.vel)
    vel[::100, :2] *= -1.0
    same = {field: np.full_like(vel[:, 0], value) for field, value in _TIGHT.items()}
    return dataclasses.replace(
        cases,
        limits=dataclasses.replace(cases.limits, **same),
        ball=dataclasses.replace(cases.ball, vel=vel),
    )


def run_row(bench: Bench, name: str, serves: Serves) -> dict[str, Any]:
    """Plan serves as the row `name`, such as `late-0.5`, defines; return success, costs and times.

    In `late-0.5` planning starts 0.5 s after the serve. The successes are added to the run's
    summary.
    """
    drag_after = name == "drag-after-impact"
    planner = pj.hit.planner("exact", drag_after_impact=drag_after)
    cases = cases_of(name, serves)
    began = time.perf_counter()
    pj.plan(planner, cases)
    first = time.perf_counter() - began
    began = time.perf_counter()
    plans = pj.plan(planner, cases)
    warm = time.perf_counter() - began
    verdict = pj.hit.judge(cases, plans, drag_after_impact=drag_after)
    success, gaps = verdict.success, cost_gaps(planner, cases, plans)
    bench.count(success, gaps)
    np.save(bench.path / f"failures-{name}.npy", np.flatnonzero(~success))
    return {
        "row": name,
        "num": success.size,
        "failures": int((~success).sum()),
        "success": success.mean(),
        "wilson_95": wilson_interval(int(success.sum()), success.size),
        "first_seconds": first,
        "warm_seconds": warm,
        "plans_per_second_warm": success.size / warm,
        "median_cost": np.median(plans.cost),
        **gap_figures(gaps),
        "refused_by_referee_alone": (pj.are_solved(plans) & ~success).sum(),
        "largest_landing_error": verdict.landing_error[success].max(initial=0.0),
    }


def main() -> None:
    parser = argument_parser("hit_rows", __doc__, num=9000)
    parser.add_argument(
        "--serves", type=Path, help="folder of published trial files; default: draw serves"
    )
    parser.add_argument(
        "--rows", default=",".join(ROWS), help="rows, comma-separated; default: all"
    )
    options = parser.parse_args()
    names = parse_names(parser, "--rows", options.rows, ROWS)
    read, num = options.serves, options.num
    serves = (pj.hit.read_serves(read) if read else pj.hit.generate_serves(num, 0))[:num]
    with begin(parser, options) as bench:
        bench.say(
            "| row | success | failures | 95 % interval | warm [s] | plans/s | median cost |",
            "|---|---|---|---|---|---|---|",
        )
        for name in names:
            figures = run_row(bench, name, serves)
            low, high = figures["wilson_95"]
            bench.say(
                f"| {name} | {100 * figures['success']:.3f} % | {figures['failures']} of "
                f"{figures['num']} | {100 * low:.2f}..{100 * high:.2f} | "
                f"{figures['warm_seconds']:.2f} | {figures['plans_per_second_warm']:.0f} | "
                f"{figures['median_cost']:.3g} |"
            )
            bench.row(**figures)


if __name__ == "__main__":
    main()
