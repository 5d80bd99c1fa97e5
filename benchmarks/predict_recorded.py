"""Measure `pj.intercept.predict` on recorded pedestrians and vehicles, beside constant velocity.

    python -m benchmarks.predict_recorded [--pedestrians DIR] [--vehicles DIR] [--num 1000]
        [--seed 0] [--out DIR]

Positions are predicted 3 s ahead. A pedestrian is observed 8 times within 2.8 s, a vehicle 11 times
within 1 s. The table has the root mean square of the errors of three predictors: `predict`, the
least-squares line through the observations, and the line through the last two observations. It also
has the share of true positions within the discs that `predict` states with a probability of 90 %,
and the median radius of these discs. The last two columns are the share and the radius if `predict`
gets the usual speed: 1.3 m/s for pedestrians and simulated targets, and 10 m/s for vehicles.

The folder of --pedestrians has text files of the collections ETH and UCY: each row has the frame
(10 frames are 0.4 s), the person, x [m] and y [m]. The folder of --vehicles has scenarios of
CommonRoad 2018b, whose dynamic obstacles have recorded positions. A recorded track that occurs in
several files is used once, and tracks shorter than 4 s are ignored. The constants of `predict` were
selected with both files `biwi` and with every second scenario in alphabetical order. A collection
without its folder is skipped. The program always measures `--num` simulated targets, which change
their velocity at random times, once in 10 s on average.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator
from pathlib import Path

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.plane.target import PlanePath

AHEAD = 3.0  # [s] Time from the last observation to the predicted position.
SHARE = 0.9  # Probability of the stated discs.
FRAME = 0.04  # [s] Duration of a frame of the pedestrians.
DEVELOPED = "biwi"  # Pedestrians with which the constants of `predict` were selected.
WALK, DRIVE = 1.3, 10.0  # [m/s] Usual speeds of pedestrians and vehicles.
Track = tuple[np.ndarray, np.ndarray]  # Times (L,) [s] and positions (L, 2) [m].
HEADS = (
    *("targets", "predictions", "`predict`, rms", "line, rms", "last two, rms"),
    *("in 90 % disc", "radius, median", "in 90 % disc, usual speed", "radius, usual speed"),
)


@jax.jit
def places(paths: PlanePath, time: float) -> jax.Array:
    """Return the positions (B, 2) [m] of a batch of paths at one time [s]."""
    return jax.vmap(lambda path: path.at(time).pos)(paths)


def read_pedestrians(file: Path) -> Iterator[Track]:
    """Yield the tracks of all persons of a file."""
    rows = np.loadtxt(file)
    for person in np.unique(rows[:, 1]):
        own = rows[rows[:, 1] == person]
        own = own[np.argsort(own[:, 0])]
        yield own[:, 0] * FRAME, own[:, 2:4]


def read_vehicles(file: Path) -> Iterator[Track]:
    """Yield the tracks of all dynamic obstacles of a CommonRoad scenario."""
    root = ElementTree.parse(file).getroot()
    step = float(root.get("timeStepSize", "nan"))
    obstacles = [one for one in root.iter("obstacle") if one.findtext("role") == "dynamic"]
    for obstacle in [*obstacles, *root.iter("dynamicObstacle")]:
        states = [*obstacle.iterfind("initialState"), *obstacle.iterfind("trajectory/state")]
        texts = ("time/exact", "position/point/x", "position/point/y")
        found = [[state.findtext(text) for text in texts] for state in states]
        rows = [[float(text) for text in row if text is not None] for row in found]
        table = np.array([row for row in rows if len(row) == 3]).reshape(-1, 3)
        yield table[:, 0] * step, table[:, 1:]


def simulate(num: int, seed: int) -> Iterator[Track]:
    """Yield tracks of targets that walk at 0.3 to 2 m/s, stop and turn, with noise of 0.05 m."""
    for k in range(num):
        rng = np.random.default_rng([seed, k])
        times = np.arange(0.0, 8.0, 0.4)
        velocity, vel = np.empty((len(times), 2)), np.zeros(2)
        for i in range(len(times)):
            if i == 0 or rng.uniform() < 0.04:
                heading, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 2.0)
                is_moving = i == 0 or rng.uniform() < 0.7
                vel = is_moving * speed * np.array([np.cos(heading), np.sin(heading)])
            velocity[i] = vel
        yield times, np.cumsum(0.4 * velocity, axis=0) + rng.normal(0.0, 0.05, (len(times), 2))


def windows(
    tracks: Iterable[Track], count: int, stride: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut tracks into windows: times (B, L) and positions (B, L, 2), and true positions (B, 2)."""
    cut = []
    for times, positions in tracks:
        if len(times) <= count:
            continue
        step = np.median(np.diff(times))
        for end in range(count - 1, len(times), stride):
            part = slice(end - count + 1, end + 1)
            then = times[end] + AHEAD
            after = int(np.searchsorted(times, then - 1e-6))
            if after == len(times) or times[after] - times[part.start] > step * (
                after - part.start + 0.01
            ):
                continue  # The track ends before, or has a gap.
            truth = [np.interp(then, times, column) for column in positions.T]
            cut.append((times[part] - times[end], positions[part], truth))
    times, seen, truth = (np.array([each[i] for each in cut]) for i in range(3))
    return times, seen, truth


def report(
    bench: Bench, name: str, tracks: Iterable[Track], count: int, stride: int, speed: float
) -> None:
    """Predict all windows of tracks of a usual speed [m/s], and print a row of the table."""
    times, seen, truth = windows(tracks, count, stride)
    if not len(times):
        bench.say(f"| {name} | 0 |" + " |" * (len(HEADS) - 2))
        return
    off, radii = [], []
    for k in range(0, len(times), 500):
        part = slice(k, k + 500)
        start = seen[part, -1]
        near = seen[part] - start[:, None]
        found, informed = (
            pj.intercept.predict(times[part], near, speed=each) for each in (None, speed)
        )
        here = np.asarray(places(found.path, AHEAD), float) + start
        off.append(np.linalg.norm(here - truth[part], axis=-1))
        ahead = np.full(len(start), AHEAD)
        radii.append([each.radius(ahead, SHARE) for each in (found, informed)])
    off, radii = np.concatenate(off), np.concatenate(radii, axis=1)
    after = times - times.mean(axis=1, keepdims=True)
    middle = seen.mean(axis=1)
    slope = np.einsum("bl,bli->bi", after, seen) / np.sum(after**2, axis=1)[:, None]
    line = middle + slope * (AHEAD - times.mean(axis=1))[:, None]
    last = (seen[:, -1] - seen[:, -2]) / (times[:, -1] - times[:, -2])[:, None]
    lines = (line, seen[:, -1] + AHEAD * last)
    errors = (off, *(np.linalg.norm(each - truth, axis=-1) for each in lines))
    rms = [float(np.sqrt(np.mean(error**2))) for error in errors]
    inside = off <= radii
    shares, sizes = inside.mean(axis=1), np.median(radii, axis=1)
    cells = [f"{each:.2f} m" for each in rms]
    for share, size in zip(shares, sizes, strict=True):
        cells += [f"{100 * share:.1f} %", f"{size:.2f} m"]
    bench.say(f"| {name} | {len(off)} | {' | '.join(cells)} |")
    figures = dict(zip(("predict", "line", "last_two"), rms, strict=True))
    for kind, share, size in zip(("", "_usual_speed"), shares, sizes, strict=True):
        figures |= {f"in_disc{kind}": share, f"radius{kind}": size}
    bench.row(name=name, num=len(off), **figures)
    bench.count(inside[0])


def main() -> None:
    parser = argument_parser("predict_recorded", __doc__, num=1000, seed=0)
    for folder, what in (("pedestrians", "*.txt files"), ("vehicles", "CommonRoad *.xml files")):
        parser.add_argument(f"--{folder}", type=Path, metavar="DIR", help=f"folder of {what}")
    options = parser.parse_args()
    with begin(parser, options) as bench:
        bench.say(f"| {' | '.join(HEADS)} |", "|---" * len(HEADS) + "|")
        report(bench, "simulated", simulate(options.num, options.seed), 8, 5, WALK)
        missing = []
        for kind, ending in (("pedestrians", "*.txt"), ("vehicles", "*.xml")):
            folder = getattr(options, kind)
            files = sorted(folder.glob(ending)) if folder else []
            if not files:
                missing.append(f"no {kind}: {folder or f'no folder --{kind}'} has no {ending} file")
            elif kind == "pedestrians":
                for file in files:
                    used = ", development" if file.stem.startswith(DEVELOPED) else ""
                    report(bench, f"{file.stem}{used}", read_pedestrians(file), 8, 1, WALK)
            else:
                known: set[bytes] = set()
                for name, some in (("development", files[::2]), ("check", files[1::2])):
                    tracks = [track for file in some for track in read_vehicles(file)]
                    new = [track for track in tracks if track[1].tobytes() not in known]
                    new = list({track[1].tobytes(): track for track in new}.values())
                    known |= {track[1].tobytes() for track in new}
                    report(bench, f"vehicles, {name}", new, 11, 5, DRIVE)
        if missing:
            bench.say("", *missing)


if __name__ == "__main__":
    main()
