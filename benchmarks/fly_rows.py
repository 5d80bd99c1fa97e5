"""Every row of the flight protocol: what is caught and hit in closed loop, with noise.

    python -m benchmarks.fly_rows [--num 1000] [--seed 0] [--rows exact,catch,hit,ablate]
                                  [--limit 300]

Noise `lab` with a latency of 20 ms; the drag is believed 15 % wrong, either way. Catches are
planned anew at 100 Hz, hits at 50 Hz and, as in [Yu2023bat], not at all. A flight of several balls
counts if all are caught. Every line has its share with the 95 % Wilson interval, where there is
one the share that it must reach, and the seconds of a second run in which nothing is compiled,
planning from scratch apart. A line that takes longer than the limit is given up as soon as the
program that runs comes back. Prediction errors stand beside the paper's greatest, (15, 5, 25) cm.
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

from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.sims.loop_state import Flown, Loop
from planner_jax.sims.noise import NOISES
from planner_jax.sims.tasks.catch import CATCH_WORLD, CatchFlights, fly_catches, throws
from planner_jax.sims.tasks.hit import HIT_WORLD, HitFlights, fly_hits, volleys
from planner_jax.task import catch, hit
from planner_jax.task.hit.spec import REAL_SCENARIOS
from planner_jax.trajectory.polynomial import evaluate

DRAG_ERROR = 0.15
CATCH_RATE, HIT_RATE = 100.0, 50.0  # [Hz], of planning anew
LAB = NOISES["lab"]
CAUGHT = {1: 0.97, 2: 0.93, 3: 0.88}  # share of flights of as many balls, to be reached
LANDING = 0.05  # [m] from the target, to be reached without noise
HORIZONS = ((0.9, 1.1), (0.7, 0.9), (0.5, 0.7), (0.3, 0.5), (0.1, 0.3))  # [s]


def share(good: np.ndarray) -> str:
    """A rate with its interval."""
    low, high = wilson_interval(int(good.sum()), good.size)
    rate = percent(int(good.sum()), good.size)
    return f"{rate} % ({100 * low:.1f} to {100 * high:.1f}, {good.size} flights)"


def quantiles(values: np.ndarray, scale: float, unit: str) -> str:
    """Median, 90 % and greatest of what is finite."""
    kept = values[np.isfinite(values)]
    if not kept.size:
        return "none"
    p50, p90, most = scale * np.quantile(kept, [0.5, 0.9, 1.0])
    return f"p50 {p50:.3g}, p90 {p90:.3g}, max {most:.3g} {unit}"


@contextlib.contextmanager
def limited(name: str, seconds: int) -> Iterator[None]:
    """Give up a line, and say so, when its seconds are over."""

    def stop(*_: Any) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    except TimeoutError:
        print(f"{name}: given up after {seconds} s", flush=True)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def twice(fly: Callable[[], Any]) -> tuple[Any, str]:
    """What a flight gives, and the seconds of the second time and of the first."""
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


def reached(good: np.ndarray, bar: float | None) -> str:
    """Whether a share is what it must be."""
    if bar is None:
        return ""
    return f", must reach {100 * bar:g} %: {'yes' if good.mean() >= bar else 'NO'}"


def tracking(flown: Flown) -> str:
    """One phrase on the tracking error."""
    worst = quantiles(flown.tracking[:, 1], 100.0, "cm")
    return f"tracking rms {100.0 * np.median(flown.tracking[:, 0]):.2f} cm, worst {worst}"


def contact_errors(flown: Flown) -> tuple[np.ndarray, np.ndarray]:
    """Planned less flown contact of the first ball: distance [m] and time [s], (B,) each."""
    planned = flown.contact.planned_time[:, 0]
    places = np.asarray(jax.vmap(evaluate)(flown.plan.trajectory, planned - flown.began))
    away = np.linalg.norm(places - flown.contact.robot_pos[:, 0], axis=1)
    return away, np.abs(flown.contact.time[:, 0] - planned)


def prediction_errors(flown: Flown) -> None:
    """Errors of where the ball is expected to be met, by the time until then."""
    assert flown.record is not None
    horizon, error = flown.record.horizon[:, :, 0], np.abs(flown.record.error[:, :, 0])
    for low, high in HORIZONS:
        chosen = error[(horizon > low) & (horizon < high)]
        if chosen.size:
            p50, p99 = (
                np.array2string(100.0 * np.quantile(chosen, q, axis=0), precision=1)
                for q in (0.5, 0.99)
            )
            print(
                f"  prediction {low:g} to {high:g} s ahead, |x| |y| |z|: p50 {p50} cm, p99 {p99} cm"
            )


def catches(
    name: str, loop: Loop, args: Any, drag_error: float, bar: float | None = None, **options: Any
) -> CatchFlights | None:
    """One line for catches."""
    cases = throws(args.num, loop.world.num_balls, args.seed, drag_error=drag_error)
    with limited(name, args.limit):
        flights, seconds = twice(lambda: fly_catches(loop, cases, args.seed, **options))
        good = flights.success
        print(
            f"{name}: all caught {share(good)}{reached(good, bar)}; ball from the net's centre "
            f"{quantiles(flights.flown.contact.offset, 100.0, 'cm')}; {tracking(flights.flown)}; "
            f"{seconds}",
            flush=True,
        )
        return flights


def hits(
    name: str, loop: Loop, regions: Any, args: Any, drag_error: float, **options: Any
) -> HitFlights | None:
    """One line for hits."""
    cases = volleys(args.num, regions, args.seed, drag_error=drag_error)
    with limited(name, args.limit):
        flights, seconds = twice(lambda: fly_hits(loop, cases, args.seed, **options))
        near, met = flights.miss <= 1.0, flights.flown.contact.met
        print(
            f"{name}: within 0.5 m {share(flights.miss <= 0.5)}, within 1 m "
            f"{percent(int(near.sum()), args.num)} %, hit {percent(int(met.sum()), args.num)} %; "
            f"landing from the target {quantiles(flights.miss, 100.0, 'cm')}; "
            f"{tracking(flights.flown)}; {seconds}",
            flush=True,
        )
        return flights


def exact_rows(args: Any) -> None:
    """Without noise: planned and flown contact, and the landing."""
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
            print(f"  landing within {100 * LANDING:g} cm {share(good)}{reached(good, 1.0)}")


def report_contact(flown: Flown) -> None:
    """One line on planned and flown contact."""
    places, times = contact_errors(flown)
    met = flown.contact.met[:, 0]
    good = (places <= 0.02) & (times <= 0.002) & met
    print(
        f"  contact: {quantiles(places[met], 100.0, 'cm')}; {quantiles(times[met], 1e3, 'ms')}; "
        f"within 2 cm and 2 ms {share(good)}{reached(good, 1.0)}",
        flush=True,
    )


def catch_rows(args: Any) -> None:
    """One, two and three balls 0.8 s apart, with noise."""
    for number in (1, 2, 3):
        world = dataclasses.replace(CATCH_WORLD, num_balls=number)
        loop = Loop(world, LAB, replan=CATCH_RATE)
        catches(f"lab, {number} ball(s)", loop, args, DRAG_ERROR, CAUGHT[number])
    loop = Loop(CATCH_WORLD, LAB, replan=CATCH_RATE, record=True)
    if flights := catches("lab, 1 ball, recorded", loop, args, DRAG_ERROR):
        prediction_errors(flights.flown)


def hit_rows(args: Any) -> None:
    """The six scenarios, with noise, re-planned and not."""
    for rate in (HIT_RATE, 0.0):
        for name, regions in REAL_SCENARIOS.items():
            loop = Loop(HIT_WORLD, LAB, replan=rate, record=name == "S.6")
            title = f"lab, {name}, re-planned {rate:g} Hz"
            flights = hits(title, loop, regions, args, DRAG_ERROR)
            if flights and loop.record:
                prediction_errors(flights.flown)


def ablated(whole: Loop) -> dict[str, Loop]:
    """A loop, and the same without one part each, by what is missing."""
    return {
        "everything": whole,
        "no Kalman filter": dataclasses.replace(whole, kalman=False),
        "no drag estimate": dataclasses.replace(whole, estimate_drag=False),
        "no re-planning": dataclasses.replace(whole, replan=0.0),
    }


def ablation_rows(args: Any) -> None:
    """What each part is worth."""
    for name, loop in ablated(Loop(CATCH_WORLD, LAB, replan=CATCH_RATE)).items():
        catches(f"lab, one ball, {name}", loop, args, DRAG_ERROR)
    loop = Loop(CATCH_WORLD, LAB)
    for name in ("catch", "mpp"):
        title = f"lab, one ball, planner {name}, no re-planning"
        catches(title, loop, args, DRAG_ERROR, planner=catch.planner(name, decide="greedy"))
    regions = REAL_SCENARIOS["S.1"]
    for name, loop in ablated(Loop(HIT_WORLD, LAB, replan=HIT_RATE)).items():
        hits(f"lab, S.1, {name}", loop, regions, args, DRAG_ERROR)
    loop = Loop(HIT_WORLD, LAB)
    for name in ("bat", "bat-lite", "juggle"):
        title = f"lab, S.1, planner {name}, no re-planning"
        hits(title, loop, regions, args, DRAG_ERROR, planner=hit.planner(name))


ROWS = {"exact": exact_rows, "catch": catch_rows, "hit": hit_rows, "ablate": ablation_rows}


def main() -> None:
    """Print the rows asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num", type=int, default=1000, help="flights a row")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=int, default=300, help="seconds a line (default: 300)")
    parser.add_argument("--rows", default=",".join(ROWS), help=f"out of {', '.join(ROWS)}")
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
