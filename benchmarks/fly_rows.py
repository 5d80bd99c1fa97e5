"""Measure success of catches and hits in closed-loop simulation of quadrotors.

    python -m benchmarks.fly_rows [--num 1000] [--seed 0] [--limit 300]
                          [--rows exact,catch,hit,hit-once,ablate,published,robot-filter]

The option --rows selects groups of lines: `exact` without noise, `catch` and `hit` with noise,
`hit-once` for hits that are planned once, at several times after the serve, `ablate`, which leaves
out one part of the control loop at a time, `published`, which estimates the balls by the default
observers and as the papers do, and `robot-filter`, in which the quadrotor's own state has random
errors or comes from a Kalman filter. The noise is `lab`, that is the noise of a motion-capture
hall, with a latency of 20 ms. The initial estimate of the ball's drag is 15 % too large or too
small. Catches are re-planned 100 times per second. Hits are re-planned 50 times per second or, as
in [Yu2023bat], not at all. A flight of several balls succeeds if all balls are caught.

Each line prints the success rate with its 95 % Wilson interval, and the required rate if there is
one. Every simulation runs twice, and the time of the second run, without compilation, is printed.
This time is divided into simulation with re-planning and planning from scratch. A simulation that
exceeds the time limit --limit is stopped as soon as the running compiled program returns. The
printed errors of the predicted contact position can be compared with the largest errors of
[Yu2023bat], (15, 5, 25) cm along x, y and z.
"""

import argparse
import contextlib
import dataclasses
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from planner_jax.core.protocol import are_solved
from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.sims.loop_state import Flown, Loop
from planner_jax.sims.noise import NOISES, RobotSensing
from planner_jax.sims.tasks.catch import CATCH_WORLD, CatchFlights, fly_catches, throws
from planner_jax.sims.tasks.hit import HIT_WORLD, SEEN, HitFlights, fly_hits, volleys
from planner_jax.task import catch, hit
from planner_jax.task.hit.spec import REAL_SCENARIOS
from planner_jax.trajectory.polynomial import evaluate

DRAG_ERROR = 0.15  # Relative error of the initial estimate of the ball's drag.
CATCH_RATE, HIT_RATE = 100.0, 50.0  # [Hz] Re-planning rates of catches and of hits.
LAB = NOISES["lab"]
CAUGHT = {1: 0.97, 2: 0.93, 3: 0.88}  # Number of balls -> required success rate of catches.
LANDING = 0.05  # [m] Greatest distance of landing and target of hits without noise.
# [s] Times from a serve to its only plan. [Yu2023bat] does not say when it plans. The 1.2 s of its
# first guess leave at most about 0.6 s of a flight.
SEEN_ONCE = (0.25, 0.4, 0.5, 0.6)
# [s] Intervals of the time until the contact. For each of them, the errors of the contact positions
# that were predicted in this interval are printed.
HORIZONS = ((0.9, 1.1), (0.7, 0.9), (0.5, 0.7), (0.3, 0.5), (0.1, 0.3))


def format_rate(good: np.ndarray) -> str:
    """Format the share of successful flights with its 95 % Wilson interval as text."""
    low, high = wilson_interval(int(good.sum()), good.size)
    rate = percent(int(good.sum()), good.size)
    return f"{rate} % ({100 * low:.1f} to {100 * high:.1f}, {good.size} flights)"


def format_quantiles(values: np.ndarray, scale: float, unit: str) -> str:
    kept = values[np.isfinite(values)]
    if not kept.size:
        return "none"
    p50, p90, most = scale * np.quantile(kept, [0.5, 0.9, 1.0])
    return f"p50 {p50:.3g}, p90 {p90:.3g}, max {most:.3g} {unit}"


@contextlib.contextmanager
def limit_time(name: str, seconds: int) -> Iterator[None]:
    """Stop the code in this context after `seconds`, and print that `name` was abandoned."""

    def stop(*_: Any) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    except TimeoutError:
        print(f"{name}: abandoned after {seconds} s", flush=True)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def run_twice(fly: Callable[[], Any]) -> tuple[Any, str]:
    """Run a simulation twice, first to compile it; return its result, and durations as text."""
    began = time.perf_counter()
    fly()
    between = time.perf_counter()
    flights = fly()
    first, second = between - began, time.perf_counter() - between
    planning = flights.planning_seconds
    return flights, (
        f"warm {second - planning:.2f} s to fly and re-plan and {planning:.2f} s to plan from "
        f"scratch; first time, with compilation, {first:.0f} s"
    )


def check_rate(good: np.ndarray, bar: float | None) -> str:
    """Return text that states whether the share of successful flights reaches the rate `bar`.

    The text is empty if `bar` is None.
    """
    if bar is None:
        return ""
    return f", must reach {100 * bar:g} %: {'yes' if good.mean() >= bar else 'NO'}"


def format_tracking(flown: Flown) -> str:
    """Format the distance of the flown from the planned position: RMS and greatest value."""
    worst = format_quantiles(flown.tracking[:, 1], 100.0, "cm")
    return f"tracking rms {100.0 * np.median(flown.tracking[:, 0]):.2f} cm, worst {worst}"


def contact_errors(flown: Flown) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the flown contact with the first ball is from the planned contact.

    Returns the errors of position [m] and of time [s], (B,) each for B flights.
    """
    planned = flown.contact.planned_time[:, 0]
    places = np.asarray(jax.vmap(evaluate)(flown.plan.trajectory, planned - flown.began))
    away = np.linalg.norm(places - flown.contact.robot_pos[:, 0], axis=1)
    return away, np.abs(flown.contact.time[:, 0] - planned)


def prediction_errors(flown: Flown) -> None:
    assert flown.record is not None
    horizon, error = flown.record.horizon[:, :, 0], np.abs(flown.record.error[:, :, 0])
    for low, high in HORIZONS:
        chosen = error[(horizon > low) & (horizon < high)]
        if chosen.size:
            p50, p99, most = (
                np.array2string(100.0 * np.quantile(chosen, q, axis=0), precision=1)
                for q in (0.5, 0.99, 1.0)
            )
            print(
                f"  prediction {low:g} to {high:g} s ahead, |x| |y| |z|: p50 {p50} cm, "
                f"p99 {p99} cm, greatest {most} cm"
            )


def catches(
    name: str, loop: Loop, args: Any, drag_error: float, bar: float | None = None, **options: Any
) -> CatchFlights | None:
    """Simulate catches, and print their success rate, errors and times in one line.

    The errors are the distance of each ball from the net's centre at its catch, and the distance of
    the flown from the planned trajectory.

    Args:
        name: label of the line.
        loop: simulated world, sensor noise and re-planning rate.
        args: command-line options; `num` flights, `seed`, and the time `limit` [s].
        drag_error: relative error of the initial estimate of the ball's drag.
        bar: required success rate; None for none.
        **options: further arguments of `fly_catches`, such as another planner.

    Returns:
        The flights, or None if the time limit was exceeded.
    """
    cases = throws(args.num, loop.world.num_balls, args.seed, drag_error=drag_error)
    with limit_time(name, args.limit):
        flights, seconds = run_twice(lambda: fly_catches(loop, cases, args.seed, **options))
        good = flights.success
        print(
            f"{name}: all caught {format_rate(good)}{check_rate(good, bar)}; "
            "ball from the net's centre "
            f"{format_quantiles(flights.flown.contact.offset, 100.0, 'cm')}; "
            f"{format_tracking(flights.flown)}; "
            f"{seconds}",
            flush=True,
        )
        return flights


def hits(
    name: str,
    loop: Loop,
    regions: Any,
    args: Any,
    drag_error: float,
    seen: float = SEEN,
    **options: Any,
) -> HitFlights | None:
    """Simulate hits, and print how near to the target the balls land, errors and times in one line.

    The line has the shares of balls that land within 0.5 m and 1 m of the target, and of flights
    that hit the ball at all.

    Args:
        name: label of the line.
        loop: simulated world, sensor noise and re-planning rate.
        regions: names of the court scenarios from which serves are drawn.
        args: command-line options; `num` flights, `seed`, and the time `limit` [s].
        drag_error: relative error of the initial estimate of the ball's drag.
        seen: [s], time from the serve to the first plan.
        **options: further arguments of `fly_hits`, such as another planner.

    Returns:
        The flights, or None if the time limit was exceeded.
    """
    cases = volleys(args.num, regions, args.seed, drag_error=drag_error, seen=seen)
    with limit_time(name, args.limit):
        flights, seconds = run_twice(lambda: fly_hits(loop, cases, args.seed, **options))
        near, met = flights.miss <= 1.0, flights.flown.contact.met
        print(
            f"{name}: within 0.5 m {format_rate(flights.miss <= 0.5)}, within 1 m "
            f"{percent(int(near.sum()), args.num)} %, hit {percent(int(met.sum()), args.num)} %; "
            f"landing from the target {format_quantiles(flights.miss, 100.0, 'cm')}; "
            f"{format_tracking(flights.flown)}; {seconds}",
            flush=True,
        )
        return flights


def exact_rows(args: Any) -> None:
    """Simulate catches and hits without sensor noise, and print how exactly plans are followed.

    Also print how far flown contacts are from planned contacts, and the share of hit balls that
    land within 5 cm of the target. `args` are the command-line options.
    """
    for rate in (0.0, CATCH_RATE):
        name = f"no noise, catch, re-planned {rate:g} Hz"
        if flights := catches(name, Loop(CATCH_WORLD, replan=rate), args, 0.0):
            report_contact(flights.flown)
    regions = tuple(dict.fromkeys(sum(REAL_SCENARIOS.values(), ())))
    for rate in (0.0, HIT_RATE):
        name = f"no noise, hit, re-planned {rate:g} Hz"
        if volley := hits(name, Loop(HIT_WORLD, replan=rate), regions, args, 0.0):
            report_contact(volley.flown)
            good = volley.miss <= LANDING
            print(
                f"  landing within {100 * LANDING:g} cm {format_rate(good)}{check_rate(good, 1.0)}"
            )


def report_contact(flown: Flown) -> None:
    """Print how far flown contacts are from the planned contacts.

    Also print the share of contacts within 2 cm and 2 ms of the plan.
    """
    places, times = contact_errors(flown)
    met = flown.contact.met[:, 0]
    good = (places <= 0.02) & (times <= 0.002) & met
    print(
        f"  contact: {format_quantiles(places[met], 100.0, 'cm')}; "
        f"{format_quantiles(times[met], 1e3, 'ms')}; "
        f"within 2 cm and 2 ms {format_rate(good)}{check_rate(good, 1.0)}",
        flush=True,
    )


def catch_rows(args: Any) -> None:
    """Print lines with sensor noise for catches of one, two and three balls, thrown 0.8 s apart."""
    for number in (1, 2, 3):
        world = dataclasses.replace(CATCH_WORLD, num_balls=number)
        loop = Loop(world, LAB, replan=CATCH_RATE)
        catches(f"lab, {number} ball(s)", loop, args, DRAG_ERROR, CAUGHT[number])
    loop = Loop(CATCH_WORLD, LAB, replan=CATCH_RATE, record=True)
    if flights := catches("lab, 1 ball, recorded", loop, args, DRAG_ERROR):
        prediction_errors(flights.flown)


def hit_rows(args: Any) -> None:
    """Print lines with sensor noise for hits in the six scenarios of [Yu2023bat].

    Each scenario is simulated with and without re-planning.
    """
    for rate in (HIT_RATE, 0.0):
        for name, regions in REAL_SCENARIOS.items():
            loop = Loop(HIT_WORLD, LAB, replan=rate, record=name == "S.6")
            title = f"lab, {name}, re-planned {rate:g} Hz"
            flights = hits(title, loop, regions, args, DRAG_ERROR)
            if flights and loop.record:
                prediction_errors(flights.flown)


def once_rows(args: Any) -> None:
    """Print lines of hits planned once, as in [Yu2023bat], over its six scenarios together.

    The lines are without and with noise, for planners and times from the serve to the plan. The
    share of flights whose plan keeps all limits by the planner, for the predicted ball, follows.
    """
    regions = tuple(dict.fromkeys(sum(REAL_SCENARIOS.values(), ())))
    for noise, drag_error in (("none", 0.0), ("lab", DRAG_ERROR)):
        for seen in SEEN_ONCE:
            for planner in ("exact", "bat", "bat-lite", "juggle"):
                loop = Loop(HIT_WORLD, NOISES[noise], record=planner == "exact")
                chosen = {} if planner == "exact" else {"planner": hit.planner(planner)}
                title = f"{noise}, planned once by {planner} after {seen:g} s"
                flights = hits(title, loop, regions, args, drag_error, seen, **chosen)
                if flights:
                    print(f"  planned {format_rate(are_solved(flights.first_plan))}", flush=True)
                    if loop.record:
                        prediction_errors(flights.flown)


def make_ablations(whole: Loop) -> dict[str, Loop]:
    """Return the control loop `whole`, and copies that each lack one part, by name.

    The parts are the Kalman filter, the drag estimate and re-planning.
    """
    return {
        "everything": whole,
        "no Kalman filter": dataclasses.replace(whole, kalman=False),
        "no drag estimate": dataclasses.replace(whole, estimate_drag=False),
        "no re-planning": dataclasses.replace(whole, replan=0.0),
    }


def ablation_rows(args: Any) -> None:
    for name, loop in make_ablations(Loop(CATCH_WORLD, LAB, replan=CATCH_RATE)).items():
        catches(f"lab, one ball, {name}", loop, args, DRAG_ERROR)
    loop = Loop(CATCH_WORLD, LAB)
    for name in ("catch", "mpp"):
        title = f"lab, one ball, planner {name}, no re-planning"
        catches(title, loop, args, DRAG_ERROR, planner=catch.planner(name, decide="greedy"))
    regions = REAL_SCENARIOS["S.1"]
    for name, loop in make_ablations(Loop(HIT_WORLD, LAB, replan=HIT_RATE)).items():
        hits(f"lab, S.1, {name}", loop, regions, args, DRAG_ERROR)
    loop = Loop(HIT_WORLD, LAB)
    for name in ("bat-fitted", "bat-lite-fitted", "juggle"):
        title = f"lab, S.1, planner {name}, no re-planning"
        hits(title, loop, regions, args, DRAG_ERROR, planner=hit.planner(name))


def published_rows(args: Any) -> None:
    """Print lines for catches and hits whose balls the default and published observers estimate."""
    for observer in ("energy", "linear"):
        loop = Loop(CATCH_WORLD, LAB, replan=CATCH_RATE, observer=observer, record=True)
        if flights := catches(f"lab, one ball, observer {observer}", loop, args, DRAG_ERROR):
            prediction_errors(flights.flown)
    regions = REAL_SCENARIOS["S.1"]
    for observer in ("energy", "rls"):
        loop = Loop(HIT_WORLD, LAB, replan=HIT_RATE, observer=observer, record=True)
        if flights := hits(f"lab, S.1, observer {observer}", loop, regions, args, DRAG_ERROR):
            prediction_errors(flights.flown)


def filter_rows(args: Any) -> None:
    """Print lines for catches and hits without and with a filter of the quadrotor's own state."""
    for sensing in (None, RobotSensing()):
        own = f"own state {'with random errors' if sensing is None else 'by a filter'}"
        loop = Loop(CATCH_WORLD, LAB, replan=CATCH_RATE, robot_filter=sensing)
        catches(f"lab, one ball, {own}", loop, args, DRAG_ERROR)
        loop = Loop(HIT_WORLD, LAB, replan=HIT_RATE, robot_filter=sensing)
        hits(f"lab, S.1, {own}", loop, REAL_SCENARIOS["S.1"], args, DRAG_ERROR)


ROWS = {
    "exact": exact_rows,
    "catch": catch_rows,
    "hit": hit_rows,
    "hit-once": once_rows,
    "ablate": ablation_rows,
    "published": published_rows,
    "robot-filter": filter_rows,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num", type=int, default=1000, help="flights a row (default: 1000)")
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    parser.add_argument(
        "--limit", type=int, default=300, help="time limit of a line [s] (default: 300)"
    )
    parser.add_argument(
        "--rows",
        default=",".join(ROWS),
        help=f"groups of rows, of {', '.join(ROWS)} (default: all)",
    )
    args = parser.parse_args()
    names = args.rows.split(",")
    if unknown := [name for name in names if name not in ROWS]:
        parser.error(f"rows must be out of {', '.join(ROWS)}, got {unknown[0]!r}")
    print(
        f"{args.num} flights a row, {jax.devices()[0].device_kind}, jax {jax.__version__}",
        flush=True,
    )
    for name in names:
        ROWS[name](args)


if __name__ == "__main__":
    main()
