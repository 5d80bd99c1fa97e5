"""How much quicker a sweep is with a Ray worker for each core than with one, on this machine, now.

    python -m benchmarks.workers [--num 60000] [--batch 2000] [--turns 3] [--out DIR]

Four ways to make the same hits take turns, so that a slow minute of the machine meets all of them:
a plain sweep bound to one core; a plain sweep bound to each core, all at the same time; one Ray
worker, bound to one core with the process that asks it; and a Ray worker for each core. The second
says how much the cores of this machine give at most, since they may share caches, memory or a
clock. A rate is of the chunks after the first few, which the workers need to begin. The cost gap is
that of a thousand of the hits. Linux, because processes are bound to cores.
"""

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.cost_gap import COMPARED, cost_gaps, gap_figures
from planner_jax.benchmarks.run import argument_parser, begin
from planner_jax.sweep.run_folder import RunFolder

_FIRST = 9  # chunks that are not counted


class _Sweep:
    """A sweep in a process of its own, on some cores, and when its chunks were there."""

    def __init__(self, out: Path, num: int, batch: int, cores: list[int], ray: bool):
        self._out, self._batch, self._times = out, batch, list[float]()
        workers = ["--workers", "ray"] if ray else []
        what = ["hit", "--num", str(num), "--batch", str(batch), *workers, "--out", str(out)]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "planner_jax", "sweep", *what],
            env={**os.environ, "NPROC": str(len(cores))},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.sched_setaffinity(self._process.pid, cores)

    def look(self) -> bool:
        """Count the chunks that are there; whether the process still runs."""
        there = len(list(self._out.glob("parts/part-*.parquet")))
        self._times += [time.perf_counter()] * (there - len(self._times))
        return self._process.poll() is None

    def rate(self) -> float:
        """Plans a second after the first chunks.

        Raises:
            RuntimeError: the sweep has failed.
        """
        if self._process.returncode != 0:
            raise RuntimeError(f"a sweep ended with exit code {self._process.returncode}")
        late = self._times[_FIRST:]
        return self._batch * (len(late) - 1) / (late[-1] - late[0])

    def summary(self) -> dict:
        """Of its manifest."""
        return RunFolder(self._out).read_manifest()["summary"]


def main() -> None:
    """Take turns and print the rates."""
    parser = argument_parser("workers", __doc__, num=60000, batch=2000, turns=3)
    options = parser.parse_args()
    if options.num < (_FIRST + 3) * options.batch:
        parser.error(f"argument --num: must be >= {_FIRST + 3} times --batch, got {options.num}")
    cores = sorted(os.sched_getaffinity(0))
    ways = {
        "a plain sweep on one core": ([cores[-1:]], False),
        "a plain sweep on each core": ([[core] for core in cores], False),
        "one worker": ([cores[-1:]], True),
        f"{len(cores)} workers": ([cores], True),
    }
    rates: dict[str, list[float]] = {name: [] for name in ways}
    summaries: dict[str, dict] = {}
    with begin(parser, options) as bench:
        for _ in range(options.turns):
            for name, (bound, ray) in ways.items():
                place = Path(tempfile.mkdtemp(prefix="workers-"))
                sweeps = [
                    _Sweep(place / str(k), options.num, options.batch, on, ray)
                    for k, on in enumerate(bound)
                ]
                while any([sweep.look() for sweep in sweeps]):
                    time.sleep(0.005)
                rates[name].append(sum(sweep.rate() for sweep in sweeps))
                summaries[name] = sweeps[0].summary()
                shutil.rmtree(place)
        planner, cases = pj.hit.planner("exact"), pj.hit.draw(COMPARED)
        gaps = cost_gaps(planner, cases, pj.plan(planner, cases))
        told = ", ".join(f"{100.0 * (each or 0.0):.1f} %" for each in gap_figures(gaps).values())
        bench.say(f"cost above a longer search's (median, p90, p99): {told}")
        bench.say("| made by | plans/s, median | lowest | highest | times one | success |")
        bench.say("|---|---|---|---|---|---|")
        for name, found in rates.items():
            one = rates["one worker" if ways[name][1] else "a plain sweep on one core"]
            times = statistics.median(f / a for f, a in zip(found, one, strict=True))
            median, success = statistics.median(found), summaries[name]["success_rate"]
            bench.count(np.arange(options.num) < summaries[name]["successes"])
            bench.say(
                f"| {name} | {median:.0f} | {min(found):.0f} | {max(found):.0f} | {times:.2f} "
                f"| {100 * success:.2f} % refereed |"
            )
            bench.row(made_by=name, plans_per_second=median, times_one=times, success=success)
            bench.note(**{f"{name}, times one": times}, **gap_figures(gaps))


if __name__ == "__main__":
    main()
