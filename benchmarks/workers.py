"""Measure the speed-up of a sweep with Ray workers on all cores or GPUs of this machine.

    python -m benchmarks.workers [--num 60000] [--batch 2000] [--turns 3] [--ways 1,2] [--out DIR]

A sweep plans many drawn cases in chunks and writes the plans to files. Four set-ups of a sweep of
hits are compared:
1. a sweep without Ray on one core;
2. a sweep without Ray on each core, all at the same time. This shows the greatest speed-up that the
   machine allows, which may be below the number of cores, because cores share caches and memory;
3. a sweep with one Ray worker, on one core together with the main process of the sweep;
4. a sweep with a Ray worker for each core.
The set-ups take turns, so that other load on the machine affects all of them. `--ways` selects
set-ups by number.

If JAX computes on GPUs, each set-up uses GPUs instead of cores, and several workers share a GPU.
The CPU cores are divided equally among the GPUs. Only in set-up 1 the sweep on one GPU uses all
cores, as a usual sweep does. On GPUs use --num 10000000 --batch 65536 or more. The temporary folder
then needs 3 kB per hit and GPU.

Plans per second are the slope of the number of written chunks over time. The first few chunks,
during which the workers start, are left out. A thousand of the planned hits are compared with a
longer search, to print how far their costs are from the optimum. The benchmark runs on Linux only,
because it binds processes to cores.
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
from planner_jax.benchmarks.run import argument_parser, begin, parse_names
from planner_jax.runs.run_folder import RunFolder
from planner_jax.sweep.cluster import WORKERS_OF_GPU

_FIRST = 9  # Least number of first chunks that the measurement of plans per second leaves out.
_GPUS, _PREALLOCATE = "CUDA_VISIBLE_DEVICES", "XLA_PYTHON_CLIENT_PREALLOCATE"


class _Share(NamedTuple):
    """Cores and GPUs of the machine that one sweep may use."""

    cores: list[int]
    gpus: list[str]  # empty if the sweep computes on the cores

    @property
    def first(self) -> int:
        """Number of first files of plans that are not timed, because workers start at that time."""
        return max(_FIRST, WORKERS_OF_GPU * len(self.gpus) if self.gpus else len(self.cores))


class _Sweep:
    """Sweep of hits in a separate process: it plans drawn cases in chunks, and writes a file each.

    The times at which the files appear are recorded.
    """

    def __init__(self, out: Path, num: int, batch: int, share: _Share, ray: bool):
        self._out, self._batch, self._first, self._times = out, batch, share.first, list[float]()
        self._errors = out.with_suffix(".stderr")
        workers = ["--workers", "ray"] if ray else []
        what = ["hit", "--num", str(num), "--batch", str(batch), *workers, "--out", str(out)]
        environ = {**os.environ, "NPROC": str(len(share.cores))}
        if share.gpus:
            environ[_GPUS] = ",".join(share.gpus)
            del environ[_PREALLOCATE]  # Only the benchmark needs this setting.
        with open(self._errors, "wb") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "planner_jax", "sweep", *what],
                env=environ,
                stdout=subprocess.DEVNULL,
                stderr=errors,
            )
        os.sched_setaffinity(self._process.pid, share.cores)

    def poll(self) -> bool:
        """Record when the sweep has written more files of plans; return whether it still runs."""
        there = len(list(self._out.glob("plans/part-*.parquet")))
        self._times += [time.perf_counter()] * (there - len(self._times))
        return self._process.poll() is None

    def rate(self) -> float:
        """Return plans per second, without the first files of plans, during which workers start.

        Raises:
            RuntimeError: the sweep has failed.
        """
        if self._process.returncode != 0:
            last = (self._errors.read_text(errors="replace").splitlines() or ["nothing"])[-1]
            raise RuntimeError(f"a sweep ended with exit code {self._process.returncode}: {last}")
        late = self._times[self._first :]
        return self._batch * np.polyfit(np.array(late) - late[0], np.arange(len(late)), 1)[0]

    def summary(self) -> dict:
        return RunFolder(self._out).read_manifest()["summary"]


def _list_setups(cores: list[int], gpus: list[str]) -> dict[str, tuple[list[_Share], bool]]:
    """Return four set-ups of sweeps, which plan many drawn cases, by name.

    They are: one sweep without Ray on one core; a sweep without Ray on each core; a sweep with one
    Ray worker; and a sweep with a Ray worker for each core. If `gpus` has names, GPUs take the
    place of cores. A set-up has a list of parts of the machine (cores and GPUs), and whether its
    sweeps use Ray. One sweep runs on each part, all at the same time.
    """
    whole, num = _Share(cores, gpus), len(gpus or cores)
    if not gpus:
        each = [_Share([core], []) for core in cores]
        return {
            "a plain sweep on one core": (each[-1:], False),
            "a plain sweep on each core": (each, False),
            "one worker": (each[-1:], True),
            f"{num} workers": ([whole], True),
        }
    cores = sorted(cores, key=_core_order)
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


def _core_order(core: int) -> tuple[int, ...]:
    """Return a sort key of a core: processor, physical core, and number.

    Sorted by it, cores of the same processor and threads of the same physical core are neighbours.
    """
    topology = Path(f"/sys/devices/system/cpu/cpu{core}/topology")
    try:
        names = "physical_package_id", "core_id"
        return *(int((topology / name).read_text()) for name in names), core
    except (OSError, ValueError):  # The system does not report packages and physical cores.
        return (core,)


def _list_gpus() -> list[str]:
    """Return the names of the GPUs that JAX uses, as in the variable CUDA_VISIBLE_DEVICES."""
    if jax.default_backend() != "gpu":
        return []
    known = os.environ.get(_GPUS)
    return known.split(",") if known else [str(k) for k in range(jax.device_count())]


def main() -> None:
    parser = argument_parser("workers", __doc__, num=60000, batch=2000, turns=3)
    known = "1,2,3,4"
    parser.add_argument("--ways", default=known, help=f"set-ups, by number; default: {known}")
    options = parser.parse_args()
    numbers = parse_names(parser, "--ways", options.ways, known.split(","))
    # JAX in this process must not reserve the GPUs' memory, which the sweeps need.
    os.environ[_PREALLOCATE] = "false"
    ways = _list_setups(sorted(os.sched_getaffinity(0)), _list_gpus())
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
                while any([sweep.poll() for sweep in sweeps]):
                    time.sleep(0.005)
                rates[name].append(sum(sweep.rate() for sweep in sweeps))
                summaries[name] = sweeps[0].summary()
                shutil.rmtree(place)
                print(f"{name}: {rates[name][-1]:.0f} plans/s", flush=True)
        planner, cases = pj.hit.planner("exact"), pj.hit.draw(COMPARED)
        gaps = cost_gaps(planner, cases, pj.plan(planner, cases))
        text = ", ".join(f"{100.0 * (each or 0.0):.1f} %" for each in gap_figures(gaps).values())
        bench.say(f"cost above a longer search (median, p90, p99): {text}")
        bench.say("| set-up | plans/s, median | lowest | highest | times one | success |")
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
