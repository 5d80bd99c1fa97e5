"""How much quicker a sweep is with Ray workers for each core or GPU than for one, on this machine.

    python -m benchmarks.workers [--num 60000] [--batch 2000] [--turns 3] [--ways 1,2] [--out DIR]

Four ways to make the same hits take turns, so that a slow minute of the machine meets all of them:
a plain sweep on one core; a plain sweep on each core, all at the same time; one Ray worker, on one
core with the process that asks it; and a Ray worker for each core. The second says how much the
cores of this machine give at most, since they may share caches, memory or a clock. `--ways` leaves
some of the four out.

Where JAX computes on GPUs these take the place of cores, and it is workers of one GPU beside those
of all; several workers share a GPU. One GPU has its share of the cores as well, but for the plain
sweep on one, which has all of them as it has without workers. There, take --num 10000000 --batch
65536 or more, and a temporary folder with room for 3 kB a hit, times the GPUs.

A rate is the slope of the chunks written over time, after the first few, which the workers need to
begin. The cost gap is that of a thousand of the hits. Linux, because processes are bound to cores.
"""

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.cost_gap import COMPARED, cost_gaps, gap_figures
from planner_jax.benchmarks.run import argument_parser, begin, chosen
from planner_jax.runs.run_folder import RunFolder
from planner_jax.sweep.cluster import WORKERS_OF_GPU

_FIRST = 9  # chunks that are not counted, at least
_GPUS, _PREALLOCATE = "CUDA_VISIBLE_DEVICES", "XLA_PYTHON_CLIENT_PREALLOCATE"


class _Share(NamedTuple):
    """What of the machine a sweep may use."""

    cores: list[int]
    gpus: list[str]  # none: it computes on the cores

    @property
    def first(self) -> int:
        """How many chunks are not counted: those that its workers begin with."""
        return max(_FIRST, WORKERS_OF_GPU * len(self.gpus) if self.gpus else len(self.cores))


class _Sweep:
    """A sweep in a process of its own, on some of the machine, and when its chunks were there."""

    def __init__(self, out: Path, num: int, batch: int, share: _Share, ray: bool):
        self._out, self._batch, self._first, self._times = out, batch, share.first, list[float]()
        self._said = out.with_suffix(".said")
        workers = ["--workers", "ray"] if ray else []
        what = ["hit", "--num", str(num), "--batch", str(batch), *workers, "--out", str(out)]
        environ = {**os.environ, "NPROC": str(len(share.cores))}
        if share.gpus:
            environ[_GPUS] = ",".join(share.gpus)
            del environ[_PREALLOCATE]  # which is for this process
        with open(self._said, "wb") as said:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "planner_jax", "sweep", *what],
                env=environ,
                stdout=subprocess.DEVNULL,
                stderr=said,
            )
        os.sched_setaffinity(self._process.pid, share.cores)

    def look(self) -> bool:
        """Count the chunks that are there; whether the process still runs."""
        there = len(list(self._out.glob("plans/part-*.parquet")))
        self._times += [time.perf_counter()] * (there - len(self._times))
        return self._process.poll() is None

    def rate(self) -> float:
        """Plans a second after the first chunks.

        Raises:
            RuntimeError: the sweep has failed.
        """
        if self._process.returncode != 0:
            said = (self._said.read_text(errors="replace").splitlines() or ["nothing"])[-1]
            raise RuntimeError(f"a sweep ended with exit code {self._process.returncode}: {said}")
        late = self._times[self._first :]
        return self._batch * np.polyfit(np.array(late) - late[0], np.arange(len(late)), 1)[0]

    def summary(self) -> dict:
        """Of its manifest."""
        return RunFolder(self._out).read_manifest()["summary"]


def _ways(cores: list[int], gpus: list[str]) -> dict[str, tuple[list[_Share], bool]]:
    """By name, the shares of the sweeps that run at the same time, and whether Ray makes them."""
    whole, num = _Share(cores, gpus), len(gpus or cores)
    if not gpus:
        each = [_Share([core], []) for core in cores]
        return {
            "a plain sweep on one core": (each[-1:], False),
            "a plain sweep on each core": (each, False),
            "one worker": (each[-1:], True),
            f"{num} workers": ([whole], True),
        }
    cores = sorted(cores, key=_place)
    ends = np.linspace(0, len(cores), num + 1).astype(int)
    each = [
        _Share(cores[first:last], [gpu])
        for gpu, first, last in zip(gpus, ends[:-1], ends[1:], strict=True)
    ]
    return {
        "a plain sweep on one GPU and all cores": ([_Share(cores, gpus[:1])], False),
        "a plain sweep on each GPU": (each, False),
        "workers of one GPU": (each[:1], True),
        f"workers of {num} GPUs": ([whole], True),
    }


def _place(core: int) -> tuple[int, ...]:
    """Where a core, as the system counts them, is: beside those of its package and threads."""
    topology = Path(f"/sys/devices/system/cpu/cpu{core}/topology")
    try:
        names = "physical_package_id", "core_id"
        return *(int((topology / name).read_text()) for name in names), core
    except (OSError, ValueError):  # the system does not say
        return (core,)


def _gpus() -> list[str]:
    """Those that JAX computes on, as CUDA_VISIBLE_DEVICES has them."""
    if jax.default_backend() != "gpu":
        return []
    known = os.environ.get(_GPUS)
    return known.split(",") if known else [str(k) for k in range(jax.device_count())]


def main() -> None:
    """Take turns and print the rates."""
    parser = argument_parser("workers", __doc__, num=60000, batch=2000, turns=3)
    known = "1,2,3,4"
    parser.add_argument("--ways", default=known, help=f"by number; default: {known}")
    options = parser.parse_args()
    numbers = chosen(parser, "--ways", options.ways, known.split(","))
    os.environ[_PREALLOCATE] = "false"  # of GPUs: the sweeps need their memory
    ways = _ways(sorted(os.sched_getaffinity(0)), _gpus())
    ways = {name: way for k, (name, way) in enumerate(ways.items(), 1) if str(k) in numbers}
    least = 3 + max(share.first for shares, _ in ways.values() for share in shares)
    if options.num < least * options.batch:
        parser.error(f"argument --num: must be >= {least} times --batch, got {options.num}")
    rates: dict[str, list[float]] = {name: [] for name in ways}
    summaries: dict[str, dict] = {}
    with begin(parser, options) as bench:
        for _ in range(options.turns):
            for name, (shares, ray) in ways.items():
                place = Path(tempfile.mkdtemp(prefix="workers-"))
                sweeps = [
                    _Sweep(place / str(k), options.num, options.batch, share, ray)
                    for k, share in enumerate(shares)
                ]
                while any([sweep.look() for sweep in sweeps]):
                    time.sleep(0.005)
                rates[name].append(sum(sweep.rate() for sweep in sweeps))
                summaries[name] = sweeps[0].summary()
                shutil.rmtree(place)
                print(f"{name}: {rates[name][-1]:.0f} plans/s", flush=True)
        planner, cases = pj.hit.planner("exact"), pj.hit.draw(COMPARED)
        gaps = cost_gaps(planner, cases, pj.plan(planner, cases))
        told = ", ".join(f"{100.0 * (each or 0.0):.1f} %" for each in gap_figures(gaps).values())
        bench.say(f"cost above a longer search's (median, p90, p99): {told}")
        bench.say("| made by | plans/s, median | lowest | highest | times one | success |")
        bench.say("|---|---|---|---|---|---|")
        for name, found in rates.items():
            one = rates[next(first for first in ways if ways[first][1] == ways[name][1])]
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
