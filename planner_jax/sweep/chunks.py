"""Draw, plan and judge the cases of a sweep in chunks (blocks), each stored in a file of rows."""

import contextlib
import functools
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
from jaxtyping import PyTree
from tqdm import tqdm

from planner_jax.core.planner import Planner
from planner_jax.host import signals as stopping
from planner_jax.host.files import crc32_of, open_plain
from planner_jax.host.threads import as_here
from planner_jax.runs.columns import RefereedBatch, rows_of
from planner_jax.runs.dataset import Dataset, encode
from planner_jax.runs.environment import environment, makers_of
from planner_jax.runs.manifest import Entries, digest_of
from planner_jax.runs.settings import SweepSettings
from planner_jax.runs.source import Chunk, Source
from planner_jax.runs.summary import percent
from planner_jax.runs.timing import CompileClock, Stopwatch, measure, measure_warm
from planner_jax.sweep.sweep import Sweep

_LARGEST = 1 << 32  # [B] greatest size of a file that a setting names
_PENDING = 2  # greatest number of chunks that are judged or written while the next chunk is planned
_MEASURED = {
    "compile_seconds": "JAX tracing, lowering, compiling or reading its cache, while chunks were "
    "made; overlapping spans counted once",
    "first_seconds": "planning the first chunk, with the compilation in it",
    "warm_seconds": "planning of chunks in which nothing was compiled, from cases to plans on the "
    "host: decisions, ball tables, guesses and all attempts. If these are less than half a batch, "
    "the first chunk is planned again. The seconds of all workers are added",
    "referee_seconds": "judging, while the next chunk is planned",
    "wall_seconds": "all chunks of all sessions that were not killed, with drawing, checking and "
    "writing; without imports and report",
}


class Record(TypedDict):
    """Description of one file of rows (a part), stored in the metadata of the Parquet file."""

    run: str  # SHA-256 of everything that affects the rows, such as the settings and the code
    number: int  # number of the chunk whose cases are in the file
    num: int  # number of rows
    successes: int  # number of plans that the referee accepted
    warm: bool  # True if JAX compiled nothing while the chunk was planned
    plan_seconds: float  # [s] time of planning, including compilation
    compile_seconds: float  # [s] time in which JAX traced or compiled
    referee_seconds: float  # [s] time of judging the plans


Made = tuple[bytes, Record]  # the bytes of a Parquet file of rows, and its record
# A function that sends chunks of cases to worker processes, which plan them. Its arguments are the
# `Maker` and the numbers of the chunks. For each chunk, in order, it yields a function that waits
# for the chunk's file of rows and returns it.
Workers = Callable[["Maker", Iterable[int]], Generator[Callable[[], Made], None, None]]


@dataclass(frozen=True)
class Maker:
    """The maker of a sweep's rows: a source of cases, a planner and a referee."""

    sweep: Sweep
    source: Source  # draws or reads the cases
    planner: Planner
    makers: Entries  # versions of packages and code, and the devices, which affect the rows
    description: Entries  # manifest entries that identify the cases of the source
    run: str  # SHA-256 of everything that affects the rows, such as settings and files they name

    @classmethod
    def of(cls, sweep: Sweep, settings: SweepSettings, batch: int) -> "Maker":
        """Open the source of cases and load the planner that the settings of a sweep name."""
        source = sweep.open_source(settings, batch)
        makers, description = makers_of(environment()), source.description()
        parameters = source.settings.parameters()
        decided = {"parameters": parameters, **description, "files": _files_of(parameters)}
        run = digest_of({"makers": makers, **decided})
        return cls(sweep, source, sweep.planner(source.settings), makers, description, run)

    def plan(self, chunk: Chunk, clock: CompileClock) -> tuple[PyTree, Record]:
        """Plan a chunk (block) of cases; return the plans, and a record with counts and times."""
        plans, seconds, warm = measure(lambda: self.sweep.plan(self.planner, chunk.cases))
        return plans, {
            "run": self.run,
            "number": int(chunk.index[0]) // self.source.batch,
            "num": len(chunk),
            "successes": 0,
            "warm": warm,
            "plan_seconds": seconds,
            "compile_seconds": clock.lap(),
            "referee_seconds": 0.0,
        }

    def make(self, number: int) -> Made:
        """Draw, plan and judge the cases of chunk `number`; return the Parquet file of its rows."""
        chunk = self.source.chunk(number)
        with CompileClock() as clock:
            return self.judge(chunk, *self.plan(chunk, clock))

    def judge(self, chunk: Chunk, plans: PyTree, record: Record) -> Made:
        """Judge the plans of a chunk of cases; return its Parquet file as bytes, and its record."""
        watch = Stopwatch()
        verdict = self.sweep.judge(chunk.cases, plans, self.source.settings)
        successes = int(np.sum(verdict.success))
        record = {**record, "referee_seconds": watch.lap(), "successes": successes}
        batch = RefereedBatch(chunk, plans, verdict)
        return encode(rows_of(self.sweep.columns(batch), batch, self.sweep.frame), record), record


def _files_of(parameters: Entries) -> dict[str, int]:
    """Return, by setting, the CRC-32 checksums of files that settings name as "NAME:FILE"."""
    found = {}
    for name, value in parameters.items():
        path = value.partition(":")[2] if isinstance(value, str) else ""
        if os.path.isfile(path):
            with open_plain(path, _LARGEST) as file:
                found[name] = crc32_of(file)
    return found


def make_parts(
    maker: Maker, rows: Dataset, there: dict[int, Record], workers: Workers | None, progress: bool
) -> dict[int, Record]:
    """Plan every chunk of cases whose file is missing; return the records of all files by number.

    While one chunk is planned, the next chunk is drawn, and previous chunks are judged and written.
    A record has a file's number of rows, successes and times. `there` has the records of existing
    files. Unless `workers` is None, other processes plan.
    """
    source, records = maker.source, dict(there)
    done, successes = (sum(each[name] for each in there.values()) for name in ("num", "successes"))
    options = {"unit": " plans", "desc": source.settings.planner, "disable": not progress}
    pending: deque[Future[Record]] = deque()

    def write(make: Callable[[], Made]) -> Record:
        content, record = make()
        rows.write(record["number"], content)
        return record

    with tqdm(total=source.num, initial=done, **options) as bar, ThreadPoolExecutor(2) as pool:
        missing = [number for number in range(source.num_chunks) if number not in there]
        making = workers(maker, missing) if workers else _make_here(maker, missing, pool)

        def wait_until(most: int) -> None:
            nonlocal done, successes
            while len(pending) > most:
                record = pending.popleft().result()
                records[record["number"]] = record
                done, successes = done + record["num"], successes + record["successes"]
                bar.set_postfix_str(f"success {percent(successes, done)} %", refresh=False)
                bar.update(record["num"])
            stopping.check()

        with contextlib.closing(making):
            wait_until(0)
            for make in making:
                pending.append(pool.submit(as_here(write), make))
                wait_until(_PENDING)
            wait_until(0)
    return records


def _make_here(
    maker: Maker, numbers: Iterable[int], pool: ThreadPoolExecutor
) -> Generator[Callable[[], Made], None, None]:
    with CompileClock() as clock:
        draws = (pool.submit(as_here(maker.source.chunk), number) for number in numbers)
        following = next(draws, None)
        while following is not None:
            chunk, following = following.result(), next(draws, None)
            yield functools.partial(maker.judge, chunk, *maker.plan(chunk, clock))


def times_of(maker: Maker, records: dict[int, Record]) -> Entries:
    """Return times [s] of a sweep's chunks (blocks of cases): compiling, planning, judging.

    "warm_seconds" is the planning time of chunks in which JAX compiled nothing. If most cases were
    planned while JAX compiled, one chunk is planned again to measure its time.
    """
    parts = [records[number] for number in sorted(records)]
    warm = [part for part in parts if part["warm"]]
    num, seconds = (sum(part[name] for part in warm) for name in ("num", "plan_seconds"))
    if 2 * num < min(maker.source.batch, maker.source.num):
        chunk = maker.source.chunk(0)
        _, seconds = measure_warm(lambda: maker.sweep.plan(maker.planner, chunk.cases))
        num = len(chunk)
    return {
        "compile_seconds": round(sum(part["compile_seconds"] for part in parts), 4),
        "first_seconds": round(parts[0]["plan_seconds"], 4),
        "warm_seconds": round(seconds, 4),
        "referee_seconds": round(sum(part["referee_seconds"] for part in parts), 4),
        "warm_plans": num,
        "measured": _MEASURED,
    }
