"""Measure `pj.ball.fit` on recorded flights of table-tennis balls: errors, intervals and time.

    python -m benchmarks.recorded_flights --flights DIR [--batch 1000] [--out DIR]

Each folder in DIR is a collection of flights, and each of its CSV files is one flight, with rows of
time [s], x, y and z [m], separated by commas or semicolons. Flights are cut into arcs at bounces,
where the vertical velocity changes its sign. Arcs from which a polynomial of degree 4 is off by
more than 8 mm (rms) are ignored. `fit` knows that the ball is for table tennis. It observes the
first 0.12 s or 0.20 s of an arc, and predicts the recorded observation nearest 0.2 s or 0.4 s after
the last one. `floor` is the median height of all bounces of the collection. The table has median
and 90 % quantile of the distances, and the share of coordinates within the 90 % intervals of an
observed position.

The last lines are the processor time of one prediction from 20 irregular times, and the time per
flight of a batch of --batch flights in one call, on the device that JAX uses.
"""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, begin

# Observed duration [s], time to the predicted observation [s], and bounces between them.
WINDOWS = (
    (0.12, 0.2, 0),
    (0.12, 0.4, 0),
    (0.20, 0.2, 0),
    (0.12, 0.2, 1),
    (0.12, 0.4, 1),
    (0.20, 0.4, 1),
)
ROW = ("name", "observed", "ahead", "bounces", "median_cm", "tail_cm", "in_interval")
NEAR = 0.006  # [s] Greatest distance of the predicted observation from its nominal time.
Flight = tuple[np.ndarray, np.ndarray, list[int]]  # Times, positions, first row of each arc.


def read_flight(file: Path) -> Flight | None:
    """Read one flight and the rows at which its arcs start; None if the file has no such rows."""
    lines = file.read_text().replace(";", ",").splitlines()
    first = 0 if lines[0][:1] in "-.0123456789" else 1
    rows = np.loadtxt(lines[first:], delimiter=",")
    if rows.ndim != 2 or rows.shape[1] != 4:
        return None
    steps = np.diff(rows[:, 0])
    if np.any(steps <= 0.0) or np.median(steps) > 0.05:
        return None
    (t, z), starts = rows[:, [0, 3]].T, [0]
    for k in range(3, len(t) - 3):
        before, after = ((z[j] - z[j - 3]) / (t[j] - t[j - 3]) for j in (k, k + 3))
        is_lowest = z[k] == z[k - 3 : k + 4].min() and k - starts[-1] > 4
        if is_lowest and before < 0.0 < after and after - before > 1.0:
            starts.append(k)
    return t, rows[:, 1:], starts


def windows(
    flights: list[Flight], observed: float, ahead: float, bounces: int
) -> Iterator[tuple[np.ndarray, np.ndarray, float, np.ndarray]]:
    """Yield times and positions of the first part of arcs, and time and position to predict."""
    for t, p, starts in flights:
        edges = [*starts, len(t)]
        for arc in range(len(starts)):
            first, end = edges[arc] + (arc > 0), edges[arc + 1]
            if end - first < 8 or arc + bounces + 1 >= len(edges):
                continue
            x = t[first:end] - t[first]
            off = [y - np.polyval(np.polyfit(x, y, 4), x) for y in p[first:end].T]
            last = first + int(np.searchsorted(x, observed + 1e-9)) - 1
            then = int(np.argmin(np.abs(t - t[last] - ahead)))
            low, high = (edges[arc + bounces] + (bounces > 0), edges[arc + bounces + 1])
            is_near = abs(t[then] - t[last] - ahead) < NEAR
            is_whole = x[last - first] > observed - 0.015 and last < end - 1
            if is_near and is_whole and low <= then < high:
                if np.sqrt(np.mean(np.sum(np.square(off), axis=0))) <= 0.008:
                    yield t[first : last + 1], p[first : last + 1], t[then], p[then]


def predict(cases: list, floor: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (B,) [m] and whether the intervals (B, 3) hold the coordinates."""
    most = max(len(times) for times, *_ in cases)
    times, seen = np.full((len(cases), most), np.nan), np.full((len(cases), most, 3), np.nan)
    for k, (t, p, *_) in enumerate(cases):
        times[k, : len(t)], seen[k, : len(t)] = t, p
    fit = pj.ball.fit(times, seen, ball="table tennis", floor=floor)
    found = fit.predict(np.array([[case[2]] for case in cases]))
    truth = np.array([case[3] for case in cases])
    low, high = (bound[:, 0] for bound in found.interval(0.9, observed=True))
    return np.linalg.norm(found.pos[:, 0] - truth, axis=1), (low < truth) & (truth < high)


def report_times(bench: Bench, batch: int) -> None:
    """Print the times of one prediction, and of a batch, of generated flights."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.uniform(0.0, 0.12, (batch, 20)), axis=1)
    vel = rng.normal([7.0, 0.0, 1.0], 1.0, (batch, 1, 3))
    p = t[..., None] * vel - np.array([0.0, 0.0, 4.905]) * t[..., None] ** 2
    p += rng.normal(0.0, 0.001, p.shape)
    spent: list[float] = []
    for part, clock, turns in ((0, time.process_time, 300), (slice(None), time.perf_counter, 3)):
        each = []
        for _ in range(turns + 1):  # the first turn compiles
            begun = clock()
            pj.ball.fit(t[part], p[part], ball="table tennis").predict([0.3])
            each.append(clock() - begun)
        spent.append(float(np.median(each[1:])))
    bench.say("", f"One prediction from 20 times: {1e3 * spent[0]:.2f} ms of processor time.")
    bench.say(f"{batch} predictions in one call: {1e6 * spent[1] / batch:.1f} us each.")
    bench.row(name="times", one_ms=1e3 * spent[0], batch=batch, each_us=1e6 * spent[1] / batch)


def main() -> None:
    parser = argument_parser("recorded_flights", __doc__, batch=1000)
    parser.add_argument(
        "--flights", type=Path, metavar="DIR", help="folder of folders of CSV files"
    )
    options = parser.parse_args()
    with begin(parser, options) as bench:
        folders = sorted(options.flights.glob("*/")) if options.flights else []
        bench.say(
            "| flights | observed | ahead | bounces | num | median | 90 % | in interval |",
            "|---" * 8 + "|",
        )
        for folder in folders:
            found = [read_flight(file) for file in sorted(folder.glob("*.csv"))]
            flights = [flight for flight in found if flight]
            if not flights:
                continue
            floor = float(np.median([p[k, 2] for _, p, starts in flights for k in starts[1:]]))
            for observed, ahead, bounces in WINDOWS:
                cases = list(windows(flights, observed, ahead, bounces))
                if not cases:
                    continue
                off, inside = predict(cases, floor)
                figures = 100 * np.median(off), 100 * np.quantile(off, 0.9), 100 * inside.mean()
                cells = f"{observed} s | {ahead} s | {bounces} | {len(off)}"
                bench.say(
                    "| {} | {} | {:.1f} cm | {:.1f} cm | {:.1f} % |".format(
                        folder.name, cells, *figures
                    )
                )
                row = (folder.name, observed, ahead, bounces, *figures)
                bench.row(**dict(zip(ROW, row, strict=True)))
                bench.count(inside.all(axis=1))
        report_times(bench, options.batch)


if __name__ == "__main__":
    main()
