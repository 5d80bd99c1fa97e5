"""The chunks of a sweep: drawn or read, planned, refereed, written and counted."""

import contextlib
import dataclasses
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import pyarrow as pa
from tqdm import tqdm

from planner_jax.host import signals as stopping
from planner_jax.host.threads import as_here
from planner_jax.runs.columns import RefereedBatch, rows_of
from planner_jax.runs.parts import EncodedRows, Part, Parts
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.source import Chunk, Source
from planner_jax.runs.summary import percent
from planner_jax.runs.timing import CompileClock, Stopwatch, timed, timed_warm
from planner_jax.sweep.sweep import Sweep

_COUNTED = ("num", "successes")  # of every part
_UNDER_WAY = 2  # chunks that are judged or written while the next is planned
_MEASURED = {
    "compile_seconds": "JAX tracing, lowering, compiling or reading its cache, while chunks were "
    "made; overlapping spans counted once",
    "first_seconds": "planning the first chunk, with the compilation in it",
    "warm_seconds": "planning of chunks in which nothing was compiled, cases to plans on the "
    "host: decisions, ball tables, guesses and all rounds. Where these were less than half a "
    "batch, the first chunk planned again. Seconds of workers are added up",
    "referee_seconds": "judging, while the next chunk is planned",
    "wall_seconds": "all chunks of all sessions with drawing, checking and writing; without "
    "imports and report",
}


@dataclasses.dataclass(frozen=True)
class _Planned:
    """One chunk, not judged yet."""

    chunk: Chunk
    plans: Any
    record: dict[str, Any]  # how long it took


@dataclasses.dataclass(frozen=True)
class Maker:
    """What is needed to make the rows of chunks."""

    sweep: Sweep
    source: Source
    planner: Any

    def planned(self, chunk: Chunk, clock: CompileClock) -> _Planned:
        """A chunk's plans. What the clock has counted since its last lap is their compilation."""
        plans, seconds, warm = timed(lambda: self.sweep.plan(self.planner, chunk.cases))
        record = {"num": len(chunk), "plan_seconds": seconds, "warm": warm}
        record["compile_seconds"] = clock.lap()
        return _Planned(chunk, plans, record)

    @property
    def counted(self) -> Sequence[str]:
        """Names of the columns that are counted; none: all are."""
        return self.sweep.tally(self.source.settings).READS

    def judged(self, planned: _Planned) -> tuple[pa.Table, dict[str, Any]]:
        """Rows and record of a chunk."""
        watch = Stopwatch()
        verdict = self.sweep.judge(planned.chunk.cases, planned.plans, self.source.settings)
        record = {
            **planned.record,
            "referee_seconds": watch.lap(),
            "successes": int(np.sum(verdict.success)),
        }
        batch = RefereedBatch(planned.chunk, planned.plans, verdict)
        return rows_of(self.sweep.columns(batch), batch, self.sweep.frame), record

    def encoded(self, rows: pa.Table, record: dict[str, Any]) -> "Made":
        """Rows and record of a chunk as they are written."""
        return EncodedRows.of(rows, self.counted), record


# Rows and record of a chunk; of one that was read, no record.
Made = tuple[EncodedRows, dict[str, Any] | None]
# Waits for a chunk that is being made.
Making = Callable[[], Made]
# Begin to make chunks of these numbers, and give them in their order.
Workers = Callable[["SweepRun", Iterable[int]], Generator[Making, None, None]]


@dataclasses.dataclass(frozen=True)
class SweepRun(Maker):
    """A sweep under way."""

    folder: RunFolder
    parts: Parts
    workers: Workers | None = None  # None: chunks are made by this process


def plan_chunks(run: SweepRun, *, progress: bool) -> dict[str, Any]:
    """Plan, referee and write every chunk that has no part yet, and join all to `plans.parquet`.

    Args:
        run: the sweep.
        progress: show a bar on the standard error stream.

    Returns:
        Entries for the manifest: `summary`, `times`, and `example`, a case worth a figure.
    """
    source, folder = run.source, run.folder
    there = run.parts.sound()
    records = {number: part.record for number, part in there.items()}
    done, successes = (sum(each[name] for each in records.values()) for name in _COUNTED)
    if progress:
        print(f"Writing {folder.shown}; the first chunk compiles.", file=sys.stderr)
    look: dict[str, Any] = {"unit": " plans", "desc": source.settings.planner}
    tally = run.sweep.tally(source.settings)
    with tqdm(total=source.num, initial=done, disable=not progress, **look) as bar:
        for chunk, rows, record in _in_pipeline(run, there):
            tally.add(rows.counted)
            if record is None:  # there already
                continue
            records[chunk] = record
            done, successes = done + record["num"], successes + record["successes"]
            bar.set_postfix_str(f"success {percent(successes, done)} %", refresh=False)
            bar.update(record["num"])
    times = _times(run, records)
    summary = tally.summary()
    summary["plans_per_second_warm"] = round(times["warm_plans"] / times["warm_seconds"], 1)
    summary["compile_seconds"] = times["compile_seconds"]
    return {"summary": summary, "times": times, "example": tally.example}


def _in_pipeline(
    run: SweepRun, there: dict[int, Part]
) -> Iterator[tuple[int, EncodedRows, dict[str, Any] | None]]:
    """Number and rows of every chunk in order, and the record of those that had no part.

    While one chunk is planned the next is drawn, the one before is judged, and the one before
    that is encoded, unless workers do so, and written.

    Args:
        run: the sweep.
        there: the parts that there are, by the numbers of their chunks.
    """
    folder, source, watch = run.folder, run.source, Stopwatch()
    pending: deque[Future] = deque()
    with (
        folder.joining_parts() as join,
        # Left in the opposite order: what has been planned is still judged, written and joined.
        ThreadPoolExecutor(1) as joiner,
        ThreadPoolExecutor(1) as writer,
        ThreadPoolExecutor(1) as judge,
        ThreadPoolExecutor(1) as drawer,
    ):

        def write(chunk: int, made: Making) -> tuple[int, EncodedRows, dict[str, Any] | None]:
            rows, record = made()
            joined = joiner.submit(join, rows.file)
            if record is not None:
                record = {**record, "wall_seconds": watch.lap()}  # since the one before
                record = run.parts.write(chunk, rows, record)
            joined.result()
            return chunk, rows, record

        missing = [chunk for chunk in range(source.num_chunks) if chunk not in there]
        if run.workers is None:
            making = _made_here(run, missing, drawer, judge)
        else:
            making = run.workers(run, missing)
        with contextlib.closing(making):
            for chunk in range(source.num_chunks):
                stopping.check()
                if chunk in there:
                    made = judge.submit(_read, run, there[chunk]).result
                else:
                    made = next(making)
                pending.append(writer.submit(write, chunk, made))
                if len(pending) > _UNDER_WAY:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()


def _read(run: SweepRun, part: Part) -> Made:
    """The rows of a part that there is."""
    return part.read(run.counted), None


def _made_here(
    run: SweepRun, numbers: Iterable[int], drawer: ThreadPoolExecutor, judge: ThreadPoolExecutor
) -> Generator[Making, None, None]:
    """Make chunks by this process: while one is planned, the next is drawn, the last is judged."""
    with CompileClock() as clock:
        draws = (drawer.submit(as_here(run.source.chunk), number) for number in numbers)
        following = next(draws, None)
        while following is not None:
            drawn, following = following, next(draws, None)
            judged = judge.submit(as_here(run.judged), run.planned(drawn.result(), clock))
            yield lambda judged=judged: run.encoded(*judged.result())


def _times(run: SweepRun, records: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """The times of the manifest, from the records of the parts by their numbers."""
    seconds = dict.fromkeys(_MEASURED, 0.0)
    warm_plans = 0
    for chunk, record in sorted(records.items()):
        for name in ("compile_seconds", "referee_seconds", "wall_seconds"):
            seconds[name] += record[name]
        if chunk == 0:
            seconds["first_seconds"] = record["plan_seconds"]
        if record["warm"]:
            warm_plans += record["num"]
            seconds["warm_seconds"] += record["plan_seconds"]
    if 2 * warm_plans < min(run.source.batch, run.source.num):
        warm_plans, seconds["warm_seconds"] = _warm_first_chunk(run)
    rounded = {name: round(value, 4) for name, value in seconds.items()}
    return {**rounded, "warm_plans": warm_plans, "measured": _MEASURED}


def _warm_first_chunk(run: SweepRun) -> tuple[int, float]:
    """Number of plans and seconds of the first chunk, planned until nothing is compiled."""
    chunk = run.source.chunk(0)
    _, seconds = timed_warm(lambda: run.sweep.plan(run.planner, chunk.cases))
    return len(chunk), seconds
