"""Targets that flee from the car: captures by cars that know little, something and all of it.

    python -m benchmarks.intercept_escape [--suite medium] [--num 32] [--seed 0]
        [--rows greedy,reach,informed] [--out DIR]

What targets can do, how they flee and what is drawn stands in
`planner_jax.studies.intercept.escape`. The car drives its plans exactly and plans anew five times a
second, `meet="early"`, from where it is; where no plan is better it goes on with the old one, and
brakes at its end. Rows:

* `greedy` takes the target to go straight on, until a wall or the map's edge stops it.
* `reach` knows what the target can do, not what it will. It plans for the target that goes
  straight on, for the middle of where it can be at any time, and for where it is now, and drives
  the plan which passes the target least far in the worst case of 16 manoeuvres.
* `informed` knows how the target will react. It plans also for the reaction to the plan that it
  drives, and takes the plan whose reaction it captures first, looking 4 s ahead: no bound in the
  strict sense, since it tries four plans a step and no more.

A target is captured where the middle of the body comes within 0.3 m within 15 s. The referee is
given the whole way up to then as one plan at steps of 20 ms, and the way that the target took:
every limit of the car, the map, polygons and the distance at the end.
"""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, begin, chosen
from planner_jax.core.protocol import lane
from planner_jax.plane.target import SampledPath
from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.studies.intercept.escape import (
    CAPTURE,
    FINE,
    HORIZON,
    ROWS,
    STEP,
    Pursued,
    draw_escapes,
    pursue,
)
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.spec import SUITES

CHUNK = 16  # lanes that a core plans in one call
HEADER = (
    "| row | captured, % (95 %) | of those that some row captures, % | "
    "time to capture p50 / p90, s | fails by | s |"
)


def judged(cases: InterceptCase, came: Pursued, k: int) -> pj.Verdict:
    """What the referee says of one chase up to the capture, or to its end."""
    end = min(came.captured[k], HORIZON)
    last = round(end / STEP * FINE)
    number = jnp.zeros(())
    case = dataclasses.replace(
        lane(cases, k),
        target=SampledPath(places=jnp.asarray(came.places[k]), step=jnp.asarray(STEP)),
        time=jnp.asarray(end),
        tolerance=jnp.asarray(CAPTURE),
    )
    plan = InterceptPlan(
        cost=number,
        violation=number,
        iterations=number,
        status=number,
        start=case.start,
        time=case.time,
        speed=jnp.asarray(came.speed[k, : last + 1]),
        curvature=jnp.asarray(came.curvature[k, : last + 1]),
        meeting=jnp.asarray(came.places[k, 0]),
    )
    return pj.intercept.judge(case, plan)


def report(bench: Bench, found: dict[str, tuple[Pursued, list[pj.Verdict], float]]) -> None:
    """Print a line a row."""
    successes = {name: np.array([v.success for v in found[name][1]]) for name in found}
    can = np.any(list(successes.values()), axis=0)
    bench.say(HEADER, "|---" * 6 + "|")
    for name, (came, verdicts, seconds) in found.items():
        good = successes[name]
        low, high = wilson_interval(int(good.sum()), good.size)
        # What is not captured takes for ever.
        times = np.where(good, came.captured, np.inf)
        median, late = np.quantile(times, (0.5, 0.9), method="higher")
        limits, counts = np.unique(
            [str(v.failed_limit) for v in verdicts if not v.success], return_counts=True
        )
        fails = dict(zip(limits.tolist(), counts.tolist(), strict=True))
        bench.say(
            f"| {name} | {percent(int(good.sum()), good.size)} ({100 * low:.1f} to "
            f"{100 * high:.1f}) | {percent(int(good.sum()), int(can.sum()))} | "
            f"{median:.2f} / {late:.2f} | "
            f"{', '.join(f'{limit} {count}' for limit, count in fails.items())} | {seconds:.0f} |"
        )
        bench.row(
            row=name,
            num=good.size,
            captured=good.mean(),
            median_time=median,
            times=times,
            fails=fails,
            seconds=seconds,
        )
        bench.note(**{f"{name}_captured": good.mean(), f"{name}_median_time": median})
    bench.count(successes["reach"] if "reach" in successes else successes[next(iter(found))])


def main() -> None:
    """Chase the same targets by every row."""
    parser = argument_parser("intercept_escape", __doc__, num=32, seed=0)
    parser.add_argument("--suite", choices=SUITES, default="medium")
    parser.add_argument("--rows", default=",".join(ROWS), help=f"out of {', '.join(ROWS)}")
    options = parser.parse_args()
    names = chosen(parser, "--rows", options.rows, ROWS)
    with begin(parser, options) as bench:
        cases, evaders, runners = draw_escapes(options.num, options.suite, options.seed)
        device = jax.devices()[0]
        bench.say(
            f"{options.num} targets that flee, suite {options.suite}, seed {options.seed}; "
            f"{device.device_kind}",
            "",
        )
        found = {}
        for name in names:
            began = time.perf_counter()
            chunk = CHUNK if device.platform == "cpu" else None
            came = pursue(name, cases, evaders, runners, chunk=chunk)
            seconds = time.perf_counter() - began
            verdicts = [judged(cases, came, k) for k in range(options.num)]
            found[name] = came, verdicts, seconds
        report(bench, found)


if __name__ == "__main__":
    main()
