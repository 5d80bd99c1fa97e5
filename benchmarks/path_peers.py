"""Run a published Hybrid A* (fastsim-navigation, extra `peers`) on searches of `intercept_paths`.

The C++ code sometimes aborts its process, so it runs in a process of its own: `python -m
benchmarks.path_peers SEARCHES.json RESULTS.jsonl FIRST` writes a line for every search, starting
with number FIRST.
"""

import importlib
import importlib.util
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

PEER = "fastsim_navigation"
INSTALL = (
    "fastsim-navigation not installed: pip install 'planner-jax[peers]' adds it to compare with "
    "(Python 3.11, Linux, x86-64)"
)
CELL, PAD = 0.1, 0.4  # [m], cell size of the cost map, and margin beyond the case's map
REPEATS = 3
_START_UP, _EACH = 30.0, 20.0  # [s], time limits of a process start and of a search


def is_installed() -> bool:
    """Return whether the peer can be imported."""
    return importlib.util.find_spec(PEER) is not None


def run_searches(searches: Sequence[dict], folder: Path) -> list[dict]:
    """Run the peer on searches; restart it after an abort.

    Args:
        searches: each with "start" and "goal" (3,), poses of the rear axle; "distance" (Y, X) [m]
            of the cost map's cells from the nearest wall; "corner" (2,) [m] of the map; "curvature"
            [1/m]; and "body", corners (4, 2) [m] ahead and to the left of the rear axle.
        folder: for temporary files.

    Returns:
        For each search "found" and "aborted", and "ms" and "poses" unless it aborted.

    Raises:
        RuntimeError: the peer does not run at all.
    """
    given, results = folder / "searches.json", folder / "results.jsonl"
    given.write_text(json.dumps(searches))
    results.write_text("")
    found: list[dict] = []
    while len(found) < len(searches):
        limit = _START_UP + REPEATS * _EACH * (len(searches) - len(found))
        command = [sys.executable, "-m", "benchmarks.path_peers", given, results, str(len(found))]
        try:
            code = subprocess.run(
                command, timeout=limit, check=False, stderr=subprocess.DEVNULL
            ).returncode
        except subprocess.TimeoutExpired:
            code = None
        lines = [json.loads(line) for line in results.read_text().splitlines()]
        found += lines[len(found) :]
        if len(found) < len(searches):
            if code == 1 and not found:
                raise RuntimeError(f"{PEER} cannot be run: see python -m benchmarks.path_peers")
            found.append({"found": False, "aborted": True})
            with results.open("a") as file:
                file.write(json.dumps(found[-1]) + "\n")
    return found


def search_one(given: dict) -> dict:
    """Run one search several times, each with a new planner; return the fastest."""
    peer: Any = importlib.import_module(PEER)
    # A cell counts as wall if a wall is within half a cell of its centre.
    cells = np.where(np.array(given["distance"]) <= 0.5 * CELL, 254, 0).astype(np.uint8)
    config = peer.PlannerConfig()
    config.allow_reverse, config.smooth_path = False, False
    config.minimum_turning_radius = 1.0 / given["curvature"]
    config.max_planning_time_seconds = _EACH
    request = peer.PlanRequest()
    request.start, request.goal = peer.Pose2D(*given["start"]), peer.Pose2D(*given["goal"])
    request.footprint = peer.PolygonFootprint([peer.Point2D(*point) for point in given["body"]])
    seconds: list[float] = []
    found: Any = None
    for _ in range(REPEATS):
        began = time.perf_counter()
        planner = peer.HybridAStar(cells, CELL, *given["corner"])
        found = planner.plan(request, config)
        seconds.append(time.perf_counter() - began)
    is_found = found.status == peer.PlannerStatus.SUCCESS
    poses = found.path_array.tolist() if is_found else []
    return {"found": is_found, "ms": 1e3 * min(seconds), "poses": poses, "aborted": False}


def main() -> None:
    """Run the searches from number FIRST on, and append a line of results for each."""
    given, results, first = sys.argv[1:]
    searches = json.loads(Path(given).read_text())
    with Path(results).open("a") as file:
        for search in searches[int(first) :]:
            file.write(json.dumps(search_one(search)) + "\n")
            file.flush()


if __name__ == "__main__":
    main()
