"""Draw the documentation's pictures of two simulated flights: a catch of three balls, and a hit.

    python -m benchmarks.fly_pictures [--out docs]

The simulated sensors have the noise `lab`, that is the noise of a motion-capture hall, and a
latency of 20 ms. The initial estimate of the ball's drag is 15 % wrong. Catches are re-planned 100
times per second, hits 50 times. Four catches and four hits are simulated. Each picture shows the
first of the four that succeeds.
"""

import argparse
from pathlib import Path

import numpy as np

from planner_jax.sims.film import draw_flight
from planner_jax.sims.settings import CatchFly, HitFly

PICTURES = {
    "fly_catch.png": (
        CatchFly(num=4, balls=3, seed=7),
        {"title": "Three balls, 0.8 s apart, are caught", "view": (16.0, -60.0)},
    ),
    "fly_hit.png": (
        HitFly(num=4, seed=7),
        {"title": "A serve is hit back to its target", "view": (12.0, -75.0)},
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--out", type=Path, default=Path("docs"), metavar="DIR", help="default: docs"
    )
    args = parser.parse_args()
    for name, (settings, style) in PICTURES.items():
        task = settings.flight()
        cases = task.cases()
        flights = task.fly(cases, record=True)
        good = flights.success
        lane = int(np.argmax(good))
        recording = task.recording(cases, flights, np.array([lane]))
        draw_flight(args.out / name, task, recording, 0, **style)
        print(f"{name}: flight {lane}; {good.sum()} of {len(good)} succeed", flush=True)


if __name__ == "__main__":
    main()
