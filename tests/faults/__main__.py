"""Try every fault in numbers, and print how often a run survived it.

    python -m tests.faults [--share F] [--only NAME,...] [--out FILE]

Survived means: killed runs are resumed to the rows of an undisturbed one; of twins one writes and
the other is refused in a line that names it; damaged files are refused in one line, mended, or read
as if whole; a signal ends the command with its own code and a line, and no traceback.
"""

import argparse
import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from tests.faults.commands import (
    Ended,
    children_of,
    finished,
    is_one_line,
    is_stopped,
    start,
)
from tests.faults.runs import TARGETS, make_runs, quick_sweeps, verdict
from tests.sweeps import rows_of

HIT = ("hit", "--num", "200", "--batch", "32", "--seed", "5")
MANY = ("hit", "--num", "20000", "--batch", "500", "--seed", "5")  # for workers
CATCH = ("catch", "--num", "96", "--batch", "16", "--seed", "5")
Survived = Iterator[tuple[bool, str]]  # and a word on how


def kills(task: tuple[str, ...], num: int, place: Path) -> Survived:
    """SIGKILL at random moments of a sweep and of what resumes it, until it is finished."""
    whole = place / "whole"
    for out in (place / "compiled", whole):  # the second one takes the usual time
        began = time.monotonic()
        assert finished(start("sweep", *task, "--out", out, cwd=place)).code == 0
    took, moment = time.monotonic() - began, random.Random(7)
    out, tried = place / "run", 0
    while tried < num:
        resume = (out / "manifest.json").exists()
        what = (task[0], "--resume", "--out", out) if resume else (*task, "--out", out)
        process = start("sweep", *what, cwd=place)
        try:
            process.wait(moment.uniform(0.2, 1.0) * took)
        except subprocess.TimeoutExpired:
            process.kill()
        ended = finished(process)
        if ended.code == -signal.SIGKILL:
            tried += 1
            yield True, "killed"
        elif ended.code == 0:
            same = rows_of(out) == rows_of(whole)
            yield from ((same, f"resumed {same}"),) if not same else ()
            shutil.rmtree(out)
        else:
            yield False, ended.err[-500:]
    last = finished(start("sweep", *what, cwd=place)) if not out.exists() else None
    resumed = finished(start("sweep", task[0], "--resume", "--out", out, cwd=place))
    if last is None and (resumed.code != 0 or rows_of(out) != rows_of(whole)):
        yield False, resumed.err[-500:]


def twins(num: int, place: Path) -> Survived:
    """Two sweeps that begin at once on one folder: one is refused, the other's rows are right."""
    whole, moment = place / "whole", random.Random(8)
    assert finished(start("sweep", *HIT, "--out", whole, cwd=place)).code == 0
    for number in range(num):
        out = place / str(number)
        pair = [start("sweep", *HIT, "--out", out, cwd=place)]
        time.sleep(moment.choice((0.0, moment.uniform(0.0, 1.0))))
        pair.append(start("sweep", *HIT, "--out", out, cwd=place))
        ends = sorted(map(finished, pair), key=lambda ended: ended.code)
        refused = is_one_line(ends[1]) and ends[1].code == 2
        good = ends[0].code == 0 and refused and rows_of(out) == rows_of(whole)
        named = "owned by process" in ends[1].err
        yield good, "named" if named else ends[1].err[-300:]
        shutil.rmtree(out, ignore_errors=True)


def worker_kills(num: int, place: Path) -> Survived:
    """SIGKILL of a Ray worker at a random moment between the first worker and the last chunk."""
    whole, moment = place / "whole", random.Random(11)
    assert finished(start("sweep", *MANY, "--out", whole, cwd=place)).code == 0
    working, tried = 1.0, 0  # seconds from the first worker to the end
    while tried < num:
        out = place / "run"
        sweep = start("sweep", *MANY, "--workers", "ray", "--out", out, cwd=place)
        workers: list[int] = []
        while sweep.poll() is None and not workers:
            raylets = children_of(sweep.pid, "raylet")
            workers = [pid for raylet in raylets for pid in children_of(raylet, "ray::_make")]
            time.sleep(0.02)
        began, killed = time.monotonic(), False
        try:
            sweep.wait(moment.uniform(0.0, working))
        except subprocess.TimeoutExpired:
            with contextlib.suppress(ProcessLookupError):
                os.kill(moment.choice(workers), signal.SIGKILL)
                killed = True
        ended = finished(sweep)
        working = time.monotonic() - began
        if killed or ended.code != 0:
            tried += 1
            good = ended.code == 0 and rows_of(out) == rows_of(whole)
            yield good, "finished" if good else f"{ended.code} {ended.err[-500:]}"
        shutil.rmtree(out, ignore_errors=True)


def mutants(what: str, num: int, place: Path) -> Survived:
    """Damage to a file of a run, and what its readers say."""
    with quick_sweeps():
        make_runs(place)
        for seed in range(num):
            chosen = random.Random(seed)
            target, name = chosen.choice(TARGETS[what])
            try:
                yield True, verdict(place, target, name, chosen, place / uuid.uuid4().hex)
            except AssertionError as error:
                yield False, str(error)


def interrupts(num: int, place: Path) -> Survived:
    """SIGINT, SIGTERM or SIGHUP at random moments, a third of them thrice in a row.

    Every second sweep has to compile. Those that had ended before the signal do not count.
    """
    moment, tried = random.Random(9), 0
    while tried < num:
        out = place / "run"
        shutil.rmtree(out, ignore_errors=True)
        compiles = tried % 2 == 0
        cache = tempfile.mkdtemp(dir=place) if compiles else None
        number = moment.choice((signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
        process = start("sweep", "hit", "--num", "200", "--out", out, cwd=place, cache=cache)
        time.sleep(moment.choice((moment.uniform(0.3, 1.0), moment.uniform(0.5, 12.0))))
        times = 1 + 2 * (tried % 3 == 0)
        alive = process.poll() is None
        for _ in range(times):
            process.send_signal(number)
            time.sleep(0.01 if times > 1 else 0.0)
        began = time.monotonic()
        ended = finished(process)
        if cache:
            shutil.rmtree(cache, ignore_errors=True)
        if not alive or ended.code == 0:
            continue
        tried += 1
        took = time.monotonic() - began
        good = is_stopped(ended, number) and took < 20.0
        yield good, number.name if good else f"{number.name} {ended.code} {ended.err[-300:]}"


def full_disk(num: int, place: Path) -> Survived:
    """A limit on the size of files, between the smallest and the largest; then without it."""
    whole, limits = place / "whole", random.Random(10)
    assert finished(start("sweep", *HIT, "--out", whole, cwd=place)).code == 0
    largest = max(path.stat().st_size for path in (whole / "plans").iterdir())
    for number in range(num):
        out = place / str(number)
        blocks = limits.randrange(1, largest // 1024)
        ended = finished(start("sweep", *HIT, "--out", out, cwd=place, blocks=blocks))
        last = ended.err.rstrip("\n").rpartition("\n")[2]
        told = ended.code in (1, 2) and "--out must be a folder that can be written" in last
        again = ("hit", "--resume", "--out", out) if out.exists() else (*HIT, "--out", out)
        resumed: Ended = finished(start("sweep", *again, cwd=place))
        good = told and resumed.code == 0 and rows_of(out) == rows_of(whole)
        yield good, f"exit {ended.code}" if good else f"{blocks} {ended.err[-300:]}"
        shutil.rmtree(out, ignore_errors=True)


# Name, words of the table, what tries it, and how often.
TRIALS: list[tuple[str, str, Callable[[int, Path], Survived], int]] = [
    ("kill-hit", "SIGKILL at a random moment, `sweep hit`", partial(kills, HIT), 100),
    ("kill-catch", "SIGKILL at a random moment, `sweep catch`", partial(kills, CATCH), 100),
    ("workers", "SIGKILL of a worker at a random moment, `--workers ray`", worker_kills, 30),
    ("twins", "two sweeps begun at once on one folder", twins, 50),
    *(
        (f"mutants-{what.replace(' ', '-')}", f"damage to {what}", partial(mutants, what), num)
        for what, num in (
            ("manifest", 500),
            ("manifest of an interrupted run", 300),
            ("parts of an interrupted run", 300),
            ("parts", 300),
            ("flights", 300),
            ("training", 200),
            ("plans.npz", 100),
        )
    ),
    ("interrupts", "SIGINT, SIGTERM, SIGHUP at a random moment", interrupts, 200),
    ("full-disk", "files that may not grow beyond a limit", full_disk, 20),
]


def main() -> int:
    """Try, print, and write the table; 1 where a run did not survive.

    Ctrl-C ends one kind of trial, and its line tells of those that were made.
    """
    parser = argparse.ArgumentParser("python -m tests.faults", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--share", type=float, default=1.0, help="of all trials (default: 1)")
    parser.add_argument("--only", help="names, comma-separated, that a trial's begins with")
    parser.add_argument("--out", type=Path, help="file for the table")
    options = parser.parse_args()
    only = tuple(options.only.split(",")) if options.only else ("",)
    lines = ["| fault | tried | survived | how |", "|---|---:|---:|---|"]
    print("\n".join(lines), flush=True)
    lost = 0
    for name, words, trial, num in TRIALS:
        if not name.startswith(only):
            continue
        found: list[tuple[bool, str]] = []
        with tempfile.TemporaryDirectory(prefix="faults-") as place:
            with contextlib.suppress(KeyboardInterrupt):
                found.extend(trial(max(1, round(options.share * num)), Path(place)))
        survived = sum(good for good, _ in found)
        how = Counter(word for good, word in found if good)
        told = ", ".join(f"{word} {count}" for word, count in how.most_common())
        lines.append(f"| {words} | {len(found):,} | {survived:,} | {told} |")
        print(lines[-1], flush=True)
        for word in (word for good, word in found if not good):
            lost += 1
            print(f"not survived: {name}: {word}", file=sys.stderr, flush=True)
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text("\n".join(lines) + "\n")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
