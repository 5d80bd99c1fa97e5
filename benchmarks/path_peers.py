"""Run the published Hybrid A* of fastsim-navigation, for comparison in `trip_peers`.

The package fastsim-navigation is installed with the extra `peers`. Its C++ code sometimes aborts
the process, so it runs in a separate process. The command `python -m benchmarks.path_peers
SEARCHES.json RESULTS.jsonl FIRST` reads path problems from a file, solves them from the problem
with index FIRST on, and appends one line a problem to RESULTS.jsonl.
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
CELL, PAD = 0.1, 0.4  # [m] Cell size of the cost map, and its margin around the case's map.
REPEATS = 3  # The fastest of this number of searches counts.
_START_UP, _EACH = 30.0, 20.0  # [s] Time limits for the start of a process and for a search.


def is_installed() -> bool:
    return importlib.util.find_spec(PEER) is not None


def run_searches(searches: Sequence[dict], folder: Path) -> list[dict]:
    """Run fastsim-navigation on path problems, in a process that is restarted after an abort.

    Args:
        searches: path problems. Each has "start" and "goal" (3,), poses of the rear axle;
            "distance" (Y, X) [m] of the cost map's cells from the nearest wall; "corner" (2,) [m],
            the lower corner of the map; "curvature" [1/m], its limit; and "body", the corners
            (4, 2) [m] of the body, ahead and to the left of the rear axle.
        folder: folder for temporary files.

    Returns:
        For each problem "found" and "aborted", and unless the search aborted, "ms" and "poses".

    Raises:
        RuntimeError: fastsim-navigation cannot be run.
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
    """Solve one path problem three times; return the path and the fastest time [ms]."""
    peer: Any = importlib.import_module(PEER)
    # A cell of the cost map counts as wall if a wall is within half a cell of the cell's centre.
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
    given, results, first = sys.argv[1:]
    searches = json.loads(Path(given).read_text())
    with Path(results).open("a") as file:
        for search in searches[int(first) :]:
            file.write(json.dumps(search_one(search)) + "\n")
            file.flush()


if __name__ == "__main__":
    main()
