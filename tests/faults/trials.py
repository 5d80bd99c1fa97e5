"""Trials: functions that each inject one kind of fault into a number of runs."""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from tests.faults import commands
from tests.faults.commands import children_of, is_one_line, is_stopped, start, wait_for
from tests.faults.quick import quick_sweeps
from tests.sweeps import rows_of

QUICK = "tests.faults.quick"
SWEEPS = {
    "hit": ("hit", "--num", "200", "--batch", "32", "--seed", "5"),
    "catch": ("catch", "--suite", "parabola2", "--num", "96", "--batch", "16", "--seed", "5"),
    "many": ("hit", "--planner", "juggle", "--num", "20000", "--batch", "500", "--seed", "5"),
}
Outcome = tuple[bool, str]  # whether a run survived, and a word on how
Survived = Iterator[Outcome]
sweep = partial(start, "sweep", module=QUICK)


class Trial(NamedTuple):
    name: str
    words: str  # of the table
    # `run` takes a random generator, a number of faults, an empty folder, and undisturbed runs.
    run: Callable[[random.Random, int, Path, Path], Survived]
    num: int
    most: int  # faults that one process tries
    whole: str  # undisturbed run in `SWEEPS`, or "" for the runs of `make_runs`


def kill(name: str, moment: random.Random, num: int, place: Path, base: Path) -> Survived:
    task, whole, out = SWEEPS[name], rows_of(base / name), place / "run"
    began, tried, took = time.monotonic(), 0, 0.0
    while tried < num or out.exists():
        is_there = (out / "manifest.json").exists()
        what = (task[0], "--resume", "--out", out) if is_there else (*task, "--out", out)
        process = sweep(*what, cwd=place)
        if 0.0 < took and tried < num:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(moment.uniform(0.2, 1.0) * took)
            process.kill()
        ended = wait_for(process)
        if ended.code == -signal.SIGKILL:
            tried += 1
            yield True, "killed"
        else:
            took = took or time.monotonic() - began
            if ended.code != 0 or rows_of(out) != whole:
                yield False, f"{ended.code} {ended.err[-500:]}"
            shutil.rmtree(out)


def start_twins(moment: random.Random, num: int, place: Path, base: Path) -> Survived:
    for number in range(num):
        out = place / str(number)
        pair = [sweep(*SWEEPS["hit"], "--out", out, cwd=place)]
        time.sleep(moment.choice((0.0, moment.uniform(0.0, 1.0))))
        pair.append(sweep(*SWEEPS["hit"], "--out", out, cwd=place))
        ends = sorted(map(wait_for, pair), key=lambda ended: ended.code)
        refused = is_one_line(ends[1]) and ends[1].code == 2
        good = ends[0].code == 0 and refused and rows_of(out) == rows_of(base / "hit")
        named = "owned by process" in ends[1].err
        yield good, "named" if named else ends[1].err[-300:]
        shutil.rmtree(out, ignore_errors=True)


def kill_workers(moment: random.Random, num: int, place: Path, base: Path) -> Survived:
    if find_spec("ray") is None:
        yield False, "ray is not installed"
        return
    working, tried, out = 1.0, 0, place / "run"  # seconds from the first worker to the end
    while tried < num:
        command = ("sweep", *SWEEPS["many"], "--workers", "ray", "--out", out)
        process = start(*command, cwd=place, cores=2)
        workers: list[int] = []
        while process.poll() is None and not workers:
            raylets = children_of(process.pid, "raylet")
            workers = [pid for raylet in raylets for pid in children_of(raylet, "ray::_make")]
            time.sleep(0.02)
        began, killed = time.monotonic(), False
        try:
            process.wait(moment.uniform(0.0, working))
        except subprocess.TimeoutExpired:
            with contextlib.suppress(ProcessLookupError):
                os.kill(moment.choice(workers), signal.SIGKILL)
                killed = True
        ended = wait_for(process)
        working = time.monotonic() - began
        if killed or ended.code != 0:
            tried += 1
            good = ended.code == 0 and rows_of(out) == rows_of(base / "many")
            yield good, "finished" if good else f"{ended.code} {ended.err[-500:]}"
        shutil.rmtree(out, ignore_errors=True)


def damage_files(what: str, moment: random.Random, num: int, place: Path, base: Path) -> Survived:
    from tests.faults.runs import TARGETS, verdict  # needs the simulators

    with quick_sweeps():
        for _ in range(num):
            target, name = moment.choice(TARGETS[what])
            try:
                yield True, verdict(base / "runs", target, name, moment, place / uuid.uuid4().hex)
            except AssertionError as error:
                yield False, str(error)


def interrupt(moment: random.Random, num: int, place: Path, base: Path) -> Survived:
    tried = 0
    while tried < num:
        out = place / "run"
        shutil.rmtree(out, ignore_errors=True)
        compiles = tried % 2 == 0
        cache = tempfile.mkdtemp(dir=place) if compiles else None
        number = moment.choice((signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
        process = sweep(*SWEEPS["hit"], "--out", out, cwd=place, cache=cache)
        late = moment.uniform(0.5, 12.0 if compiles else 6.0)
        commands.wait_until_listening(process)
        time.sleep(moment.choice((moment.uniform(0.0, 1.0), late)))
        times = 1 + 2 * (tried % 3 == 0)
        alive = process.poll() is None
        for _ in range(times):
            process.send_signal(number)
            time.sleep(0.01 if times > 1 else 0.0)
        began = time.monotonic()
        ended = wait_for(process)
        if cache:
            shutil.rmtree(cache, ignore_errors=True)
        if not alive or ended.code == 0:
            continue
        tried += 1
        took = time.monotonic() - began
        good = is_stopped(ended, number) and took < 20.0
        yield good, number.name if good else f"{number.name} {ended.code} {ended.err[-300:]}"


def fill_disk(limits: random.Random, num: int, place: Path, base: Path) -> Survived:
    whole = base / "hit"
    largest = max(path.stat().st_size for path in (whole / "plans").iterdir())
    for number in range(num):
        out = place / str(number)
        blocks = limits.randrange(1, largest // 1024)
        ended = wait_for(sweep(*SWEEPS["hit"], "--out", out, cwd=place, blocks=blocks))
        last = ended.err.rstrip("\n").rpartition("\n")[2]
        named = ended.code in (1, 2) and "--out must be a folder that can be written" in last
        again = ("hit", "--resume") if out.exists() else SWEEPS["hit"]
        resumed = wait_for(sweep(*again, "--out", out, cwd=place))
        good = named and resumed.code == 0 and rows_of(out) == rows_of(whole)
        yield good, f"exit {ended.code}" if good else f"{blocks} {ended.err[-300:]}"
        shutil.rmtree(out, ignore_errors=True)


NUM_DAMAGED = {"manifest": 500, "manifest of an interrupted run": 300}
NUM_DAMAGED |= {"parts of an interrupted run": 300, "parts": 300, "flights": 300}
NUM_DAMAGED |= {"training": 200, "plans.npz": 100}
TRIALS = [
    *(
        Trial(
            *(f"kill-{task}", f"SIGKILL at a random moment, `sweep {task}`", partial(kill, task)),
            *(100, 10, task),
        )
        for task in ("hit", "catch")
    ),
    Trial(
        *("workers", "SIGKILL of a worker at a random moment, `--workers ray`", kill_workers),
        *(30, 5, "many"),
    ),
    Trial("twins", "two sweeps that start at once on one folder", start_twins, 50, 5, "hit"),
    *(
        Trial(
            *(f"mutants-{what.replace(' ', '-')}", f"damage to {what}"),
            *(partial(damage_files, what), num, 50, ""),
        )
        for what, num in NUM_DAMAGED.items()
    ),
    Trial("interrupts", "SIGINT, SIGTERM, SIGHUP at a random moment", interrupt, 200, 10, "hit"),
    Trial("full-disk", "files that may not grow beyond a limit", fill_disk, 20, 2, "hit"),
]


def make_whole(name: str, base: Path) -> None:
    if not name:
        from tests.faults.runs import make_runs  # needs the simulators

        with quick_sweeps():
            return make_runs(base / "runs")
    module = "planner_jax" if name == "many" else QUICK
    ended = wait_for(start("sweep", *SWEEPS[name], "--out", base / name, cwd=base, module=module))
    assert ended.code == 0, ended.err


def try_some(place: int, part: int, num: int, base: Path) -> list[Outcome]:
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        moment = random.Random(f"{TRIALS[place].name} {part}")
        return list(TRIALS[place].run(moment, num, Path(folder), base))
