"""Compare this library's Hybrid A* with a published one, and measure the smoothing of its paths.

    python -m benchmarks.intercept_paths [--num 50] [--seed 0] [--out DIR]

The problems are paths of a car among static walls. Walls, starts and meeting points are from the
suites `hard` and `maze`, without their moving obstacles. First this library searches paths with any
heading at the meeting. Then the headings that it found are prescribed, because the published
planner fastsim-navigation (C++, extra `peers`) needs a heading at the goal. Both planners get the
same start and goal poses. This library represents walls by a distance field, and the car by discs
that cover its body. fastsim-navigation represents walls by cells of 0.1 m, and the car by the exact
rectangle of its body.

A time is for one search without compilation, from walls to poses, the fastest of three calls. A
path is clear if the body's rectangle touches no wall at any of its poses. Lengths are means over
the problems for which every planner of the table has found a path. The last table is about
smoothing. Its paths were searched with nine tenths of the curvature limit.
"""

import dataclasses
import functools
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.baselines.intercept.hybrid_astar import HybridPath, hybrid_astar
from planner_jax.baselines.intercept.path_smoothing import smooth_path
from planner_jax.benchmarks.path_peers import CELL, INSTALL, PAD, is_installed, run_searches
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.plane.obstacles import distances, separation
from planner_jax.task.intercept.api import draw, positions

SUITES = ("hard", "maze")
CURVATURE_SHARE = 0.9  # Factor of the curvature limit in searches whose paths are smoothed.
REPEATS = 3  # The fastest of this number of calls is reported.


@dataclasses.dataclass(frozen=True)
class Row:
    """Results of one planner on B path problems."""

    found: np.ndarray  # (B,) bool, whether the planner has found a path
    clear: np.ndarray  # (B,) bool, whether the body touches no wall at any pose of the path
    length: np.ndarray  # (B,) [m], length of the path
    ms: np.ndarray  # (B,) [ms], time of the search; NaN if the planner has aborted
    note: str = ""


def body_of(case: Any) -> tuple[float, float, float]:
    """Return the coordinates of the body's rear and front end, and half its width [m].

    The coordinates are along the car, and zero at the rear axle.
    """
    behind = -float(case.body.rear_overhang)
    return behind, behind + float(case.body.length), 0.5 * float(case.body.width)


def search(case: Any, meeting: np.ndarray, share: float = 1.0, **options: Any) -> HybridPath:
    """Search a path from the start of one case to its meeting point (2,) [m] by Hybrid A*.

    The curvature limit is multiplied by `share`. The case has NumPy leaves. `options` are further
    arguments of `hybrid_astar`, such as a heading at the meeting point.
    """
    return hybrid_astar(
        case.start,
        meeting,
        case.walls,
        curvature=share * float(case.limits.curvature),
        body=body_of(case),
        lower=case.lower,
        upper=case.upper,
        **options,
    )


def time_fastest(run: Callable[[], Any]) -> tuple[Any, float]:
    """Call a function three times; return its result, and the fastest call's duration [ms]."""
    seconds, result = [], None
    for _ in range(REPEATS):
        began = time.perf_counter()
        result = jax.block_until_ready(run())
        seconds.append(time.perf_counter() - began)
    return result, 1e3 * min(seconds)


@jax.jit
def _gap(poses: jax.Array, walls: Any, body: jax.Array) -> jax.Array:
    x, y, heading = poses.T
    vertices = walls.vertices(jnp.zeros_like(x[0]))
    return separation(vertices, walls.present, x[None], y[None], heading, tuple(body)).min()


def is_clear(case: Any, poses: np.ndarray, num: int = 513) -> bool:
    """Return whether the body touches no wall at poses (N, 3) of the rear axle.

    At most `num` of the poses, equally spaced, are checked.
    """
    places = np.linspace(0, len(poses) - 1, num).astype(int)
    body = jnp.asarray(body_of(case), jnp.float32)
    return bool(_gap(jnp.asarray(poses[places], jnp.float32), case.walls, body) > 0.0)


def row_of(cases: list, paths: list[HybridPath], ms: np.ndarray) -> Row:
    found = np.array([path.found for path in paths])
    pairs = zip(cases, paths, strict=True)
    clear = [path.found and is_clear(case, path.poses) for case, path in pairs]
    length = np.array([path.length for path in paths])
    median = np.median([path.expansions for path in paths])
    return Row(found, np.array(clear), length, ms, f"{median:.0f} expansions, median")


def search_row(cases: list, meetings: np.ndarray, headings: list[float | None]) -> Row:
    """Search a path to each case's meeting point with this library, and return the results.

    A heading [rad] at the meeting point is prescribed, or arbitrary if it is None.
    """
    results = [
        time_fastest(functools.partial(search, case, meeting, end_heading=heading))
        for case, meeting, heading in zip(cases, meetings, headings, strict=True)
    ]
    paths, ms = zip(*results, strict=True)
    return row_of(cases, list(paths), np.array(ms))


def measure_cells(case: Any) -> tuple[np.ndarray, np.ndarray]:
    """Compute the distances [m] of square cells of the side `CELL` from the walls of one case.

    Returns:
        corner: (2,) [m], the lower corner of the grid, `PAD` beyond the case's map.
        distance: (Y, X) [m], of the cells' centres, negative in a wall.
    """
    corner = case.lower.astype(float) - PAD
    size = np.ceil((case.upper + PAD - corner) / CELL - 1e-6).astype(int)
    x, y = (corner[k] + CELL * (np.arange(size[k]) + 0.5) for k in range(2))
    east, north = (jnp.asarray(each, jnp.float32).reshape(1, -1) for each in np.meshgrid(x, y))
    far = distances(case.walls.vertices(np.float32(0.0)), case.walls.present, east, north)[0]
    far = np.asarray(far) - case.walls.radius[:, None]
    return corner, far.min(axis=0).reshape(size[::-1])


def describe_search(
    case: Any, meeting: np.ndarray, heading: float, margin: float = 0.0
) -> dict[str, Any]:
    """Return a path problem of `run_searches`; the body is enlarged by `margin` [m] on all sides.

    `heading` [rad] is prescribed at the meeting point (2,) [m] of the body's middle.
    """
    (behind, ahead, half), (corner, distance) = body_of(case), measure_cells(case)
    direction = np.array([np.cos(heading), np.sin(heading)])
    rear, front, side = behind - margin, ahead + margin, half + margin
    return {
        "start": case.start.tolist(),
        "goal": [*(meeting - 0.5 * (behind + ahead) * direction), heading],
        "distance": distance.tolist(),
        "corner": corner.tolist(),
        "curvature": float(case.limits.curvature),
        "body": [[rear, -side], [front, -side], [front, side], [rear, side]],
    }


def peer_row(cases: list, meetings: np.ndarray, headings: list[float]) -> Row:
    """Search a path to each meeting point with fastsim-navigation, and return the results.

    `headings` are the prescribed headings [rad] at the meeting points, one for each case.
    """
    searches = [
        describe_search(case, meeting, heading)
        for case, meeting, heading in zip(cases, meetings, headings, strict=True)
    ]
    with tempfile.TemporaryDirectory() as folder:
        results = run_searches(searches, Path(folder))
    found = np.array([each["found"] for each in results])
    paths = [np.array(each["poses"]) if each["found"] else np.zeros((1, 3)) for each in results]
    steps = [np.diff(path[:, :2], axis=0) for path in paths]
    length = np.array([np.hypot(*step.T).sum() for step in steps])
    clear = [f and is_clear(case, path) for f, case, path in zip(found, cases, paths, strict=True)]
    aborted = sum(each["aborted"] for each in results)
    ms = np.array([each.get("ms", np.nan) for each in results])
    return Row(found, np.array(clear), length, ms, f"{aborted} aborted")


def say_rows(bench: Bench, suite: str, heading: str, rows: dict[str, Row]) -> None:
    """Print success, path length and time of each planner of paths, for the problems of one suite.

    Lengths are means over the problems that all planners solve. `heading` states whether the
    heading at the meeting point is free or prescribed.
    """
    together = np.logical_and.reduce([row.found for row in rows.values()])
    for name, row in rows.items():
        ms = np.nanpercentile(row.ms, [50, 95, 99]) if np.isfinite(row.ms).any() else [np.nan] * 3
        length = row.length[together].mean() if together.any() else np.nan
        bench.say(
            f"| {suite} | {heading} | {name} | {100 * row.found.mean():.0f} % | "
            f"{100 * row.clear.mean():.0f} % | {length:.3f} | "
            f"{ms[0]:.2f} / {ms[1]:.2f} / {ms[2]:.2f} | {row.note} |"
        )
        figures = {"found": row.found.mean(), "clear": row.clear.mean(), "length": length, "ms": ms}
        bench.row(suite=suite, heading=heading, planner=name, **figures)


def say_smoothing(bench: Bench, suite: str, batch: Any, cases: list, meetings: np.ndarray) -> None:
    pairs = zip(cases, meetings, strict=True)
    paths = [search(case, meeting, CURVATURE_SHARE) for case, meeting in pairs]

    @jax.jit
    def smooth(poses: jax.Array, bends: jax.Array, length: jax.Array, case: Any) -> Any:
        behind = -case.body.rear_overhang
        return smooth_path(
            *(poses, bends, length, case.walls),
            curvature=case.limits.curvature,
            body=(behind, behind + case.body.length, 0.5 * case.body.width),
            lower=case.lower,
            upper=case.upper,
        )

    results = []
    for k, path in enumerate(paths):
        if path.found:
            case = jax.tree.map(lambda leaf, k=k: leaf[k], batch)
            given = (np.float32(leaf) for leaf in (path.poses, path.curvature, path.length))
            given = (*given, case)
            smooth(*given)
            found, ms = time_fastest(lambda given=given: smooth(*given))
            results.append((path.length, float(found.length), bool(found.is_smooth), ms))
    before, after, is_smooth, ms = np.array(results).T
    times = np.percentile(ms, [50, 95, 99])
    bench.say(
        f"| {suite} | {len(results)} | {100 * is_smooth.mean():.0f} % | {before.mean():.3f} | "
        f"{after.mean():.3f} | {times[0]:.2f} / {times[1]:.2f} / {times[2]:.2f} |"
    )
    bench.row(suite=suite, smoothed=is_smooth.mean(), before=before.mean(), after=after.mean())


def main() -> None:
    parser = argument_parser("intercept_paths", __doc__, num=50, seed=0)
    options = parser.parse_args()
    with begin(parser, options) as bench:
        bench.say(
            f"{options.num} cases a suite, seed {options.seed}, load average "
            f"{os.getloadavg()[0]:.1f}",
            "",
            "| suite | heading | search | found | clear | length [m] | p50 / p95 / p99 [ms] | |",
            "|---|---|---|---|---|---|---|---|",
        )
        drawn = {}
        for suite in SUITES:
            batch = draw(options.num, suite, options.seed)
            meetings = positions(batch.target, np.asarray(batch.time))
            host = jax.tree.map(np.asarray, batch)
            cases = [jax.tree.map(lambda leaf, k=k: leaf[k], host) for k in range(options.num)]
            drawn[suite] = (batch, cases, meetings)
            paths = [search(case, meeting) for case, meeting in zip(cases, meetings, strict=True)]
            row = search_row(cases, meetings, [None] * options.num)
            say_rows(bench, suite, "free", {"this library": row})
            bench.count(row.clear)
            # If no path was found, the heading 0 is prescribed at the meeting.
            headings = [float(path.poses[-1, 2]) if path.found else 0.0 for path in paths]
            rows = {"this library": search_row(cases, meetings, list(headings))}
            if is_installed():
                rows["fastsim-navigation"] = peer_row(cases, meetings, headings)
            say_rows(bench, suite, "prescribed", rows)
        if not is_installed():
            bench.say("", INSTALL)
        bench.say(
            "",
            "| suite | paths | smooth | length before [m] | after [m] | p50 / p95 / p99 [ms] |",
            "|---|---|---|---|---|---|",
        )
        for suite, given in drawn.items():
            say_smoothing(bench, suite, *given)


if __name__ == "__main__":
    main()
