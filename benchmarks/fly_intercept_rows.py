"""Measure the share of targets that a simulated car meets, with different sensing and tyres.

    python -m benchmarks.fly_intercept_rows [--suite hard] [--num 50] [--seed 0]
                                            [--rows sensing,replan,latency,slip]

Each row of the table simulates drives of a car that meets moving targets among obstacles, and
changes one setting: what is known about the target, the rate of re-planning, the latency of
observations, or the slip of the tyres. The miss is the distance of the body's middle from the true
target when the plan ends. A meeting counts as success if the miss is at most 0.3 m and the car has
touched nothing. Contacts are checked with exact polygons every 20 ms.

By default, targets are observed 15 times before the start and then once a second, with noise of 0.1
m. The car's own pose is observed with noise of 1 cm and 0.01 rad. All observations are 50 ms old,
and the car re-plans once a second. For each row the program also prints a command, which runs the
same drives and writes a run folder.
"""

import argparse
import dataclasses
import time
from typing import Any

import jax
import numpy as np

from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.sims.settings import InterceptFly
from planner_jax.sims.tasks.intercept import SUCCESS, TOUCH, InterceptFlights, fly_intercepts
from planner_jax.sims.tasks.intercept_flights import FAR, NEAR
from planner_jax.task.intercept.plan import InterceptPlan

# Group of rows -> row name -> settings of the simulation that differ from the defaults.
ROWS: dict[str, dict[str, dict[str, Any]]] = {
    "sensing": {
        "everything known": {"known_target": True, "noise": "none", "latency": 0.0, "replan": 0.0},
        "everything known, re-planned": {"known_target": True, "noise": "none", "latency": 0.0},
        "target known, noise and latency": {"known_target": True},
        "target predicted": {},
        "target predicted, never re-planned": {"replan": 0.0},
        "ten observations a second": {"observation_rate": 10.0},
        "movers predicted as well": {"predict_movers": True},
    },
    "replan": {f"re-planned at {rate:g} Hz": {"replan": rate} for rate in (0.0, 1.0, 2.0, 10.0)},
    "latency": {f"latency {1e3 * age:g} ms": {"latency": age} for age in (0.0, 0.05, 0.1)},
    "slip": {
        "tyres that slip": {"slip": True},
        "tyres that slip, never re-planned": {"slip": True, "replan": 0.0},
    },
}
HEADER = (
    "| row | success % (95 %) | <= 0.05 / 0.3 / 0.5 m, % | miss p50, m | wall / mover touched, % | "
    "tracking rms p50 / worst, cm | drive / steering saturated, % | s |"
)


def line(name: str, flights: InterceptFlights, seconds: float) -> str:
    """Format success, misses, contacts, tracking errors and saturation of simulated drives as text.

    `name` labels the row of the table, and `seconds` is the duration of the simulation.
    """
    good, miss, number = flights.success, flights.miss, len(flights.miss)
    low, high = wilson_interval(int(good.sum()), number)
    within = " / ".join(percent(int((miss <= d).sum()), number) for d in (NEAR, SUCCESS, FAR))
    touched = " / ".join(
        percent(int((clearance < -TOUCH).sum()), number)
        for clearance in (flights.wall_clearance, flights.mover_clearance)
    )
    tracking = flights.flown.tracking
    rms, worst = 100.0 * np.median(tracking[:, 0]), 100.0 * tracking[:, 1].max()
    drive, steering = 100.0 * flights.flown.saturation.mean(axis=0)
    return (
        f"| {name} | {percent(int(good.sum()), number)} ({100 * low:.1f} to {100 * high:.1f}) | "
        f"{within} | {np.median(miss):.3f} | {touched} | {rms:.2f} / {worst:.1f} | "
        f"{drive:.2f} / {steering:.2f} | {seconds:.0f} |"
    )


def command(settings: InterceptFly) -> str:
    """Return the shell command that simulates drives with these settings into a run folder."""
    own = InterceptFly(suite=settings.suite, num=settings.num, seed=settings.seed)
    words = [f"--suite {settings.suite} --num {settings.num} --seed {settings.seed}"]
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if value != getattr(own, field.name):
            flag = f"--{field.name.replace('_', '-')}"
            shown = value if isinstance(value, str) else f"{value:g}"
            words.append(flag if value is True else f"{flag} {shown}")
    return " ".join(["planner-jax fly intercept", *words])


def run_drives(
    settings: InterceptFly, first_plans: dict[tuple, InterceptPlan]
) -> tuple[InterceptFlights, float]:
    """Simulate drives with given settings; return them, and the duration of the simulation [s].

    The plan at the start depends only on observations before the start. Settings with equal
    observations therefore use the same plans, which are stored in `first_plans`.
    """
    task, key = settings.flight(), (settings.known_target, settings.predict_movers, settings.noise)
    began = time.perf_counter()
    flights = fly_intercepts(
        task.loop(),
        task.cases(),
        settings.seed,
        replan=settings.rate,
        plan=first_plans.get(key),
        known_target=settings.known_target,
        predict_movers=settings.predict_movers,
    )
    first_plans[key] = flights.first_plan
    return flights, time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--suite", default="hard", help="default: hard")
    parser.add_argument("--num", type=int, default=50, help="drives a row; default: 50")
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    parser.add_argument(
        "--rows", default=",".join(ROWS), help=f"groups of rows, of {', '.join(ROWS)}; default: all"
    )
    args = parser.parse_args()
    names = args.rows.split(",")
    if unknown := [name for name in names if name not in ROWS]:
        parser.error(f"rows must be out of {', '.join(ROWS)}, got {unknown[0]!r}")
    device = jax.devices()[0].device_kind
    print(f"{args.num} drives a row, suite {args.suite}, {device}, jax {jax.__version__}")
    print(f"{HEADER}\n|{'---|' * 8}", flush=True)
    commands, first_plans, lines = [], {}, {}
    for name in names:
        for row, options in ROWS[name].items():
            settings = InterceptFly(suite=args.suite, num=args.num, seed=args.seed, **options)
            commands.append(f"{row}: {command(settings)}")
            if settings not in lines:
                lines[settings] = run_drives(settings, first_plans)
            print(line(row, *lines[settings]), flush=True)
    print("\n".join(["", *commands]))


if __name__ == "__main__":
    main()
