"""The chunks of a sweep: drawn or read, planned, refereed, written and counted."""

import dataclasses
import sys
from collections.abc import Iterable
from typing import Any

import numpy as np
from tqdm import tqdm

from planner_jax.sweep.columns import RefereedBatch, rows_of
from planner_jax.sweep.run_folder import RunFolder
from planner_jax.sweep.source import Source
from planner_jax.sweep.summary import percent
from planner_jax.sweep.task import SweepTask
from planner_jax.sweep.timing import CompileClock, Stopwatch

_MEASURED = {
    "compile_seconds": "JAX tracing, lowering, compiling or reading its cache, while chunks were "
    "made; overlapping spans counted once",
    "first_seconds": "planning the first chunk, with the compilation in it",
    "warm_seconds": "planning of chunks in which nothing was compiled, scenarios to plans on the "
    "host: decisions, ball tables, guesses and all rounds. Where these were less than half a "
    "batch, the first chunk planned again",
    "referee_seconds": "judging, without planning",
    "wall_seconds": "all chunks of all sessions with drawing, checking and writing; without "
    "imports, merging and report",
}


@dataclasses.dataclass(frozen=True)
class SweepRun:
    """A sweep under way."""

    task: SweepTask
    source: Source
    planner: Any
    folder: RunFolder


def plan_chunks(run: SweepRun, *, progress: bool) -> None:
    """Plan, referee and write every chunk that has no part yet.

    Args:
        run: the sweep.
        progress: show a bar on the standard error stream.
    """
    source, folder = run.source, run.folder
    records = (folder.part_record(chunk) for chunk in range(source.num_chunks))
    done, successes = _progress(record for record in records if record)
    watch = Stopwatch()
    if progress:
        print(f"Writing {folder.path}; the first chunk compiles.", file=sys.stderr)
    look: dict[str, Any] = {"unit": " plans", "desc": source.settings.planner}
    with tqdm(total=source.num, initial=done, disable=not progress, **look) as bar:
        for chunk in range(source.num_chunks):
            if folder.part_record(chunk):
                continue
            batch, record = _plan_chunk(run, chunk)
            record["successes"] = int(np.sum(batch.verdict.success))
            record["wall_seconds"] = watch.lap()
            rows = rows_of(run.task.columns, batch, run.task.frame)
            folder.write_part(chunk, rows, record)
            done, successes = done + record["num"], successes + record["successes"]
            bar.set_postfix_str(f"success {percent(successes, done)} %", refresh=False)
            bar.update(record["num"])


def _progress(records: Iterable[dict[str, Any]]) -> tuple[int, int]:
    """How many plans some parts hold, and how many of them succeed."""
    done, successes = 0, 0
    for record in records:
        done, successes = done + record["num"], successes + record["successes"]
    return done, successes


def _plan_chunk(run: SweepRun, chunk: int) -> tuple[RefereedBatch, dict[str, Any]]:
    """One chunk, and how long it took."""
    source = run.source
    with CompileClock() as clock:
        cases = source.chunk(chunk)
        (scenarios, plans), seconds, warm = _timed_plan(run, cases.scenarios)
        watch = Stopwatch()
        verdict = run.task.judge(scenarios, plans, source.settings)
        referee_seconds = watch.lap()
    record = {
        "num": len(cases),
        "plan_seconds": seconds,
        "warm": warm,
        "compile_seconds": clock.seconds,
        "referee_seconds": referee_seconds,
    }
    return RefereedBatch(cases, scenarios, plans, verdict), record


def _timed_plan(run: SweepRun, scenarios: Any) -> tuple[Any, float, bool]:
    """Scenarios and plans, the seconds they took, and whether nothing was compiled meanwhile."""
    watch = Stopwatch()
    with CompileClock() as clock:
        planned = run.task.plan(run.planner, scenarios, run.source.settings)
    return planned, watch.lap(), not clock.compiled


def merge_chunks(run: SweepRun) -> dict[str, Any]:
    """Join the parts to `plans.parquet`.

    Args:
        run: the sweep, every chunk of it planned.

    Returns:
        Entries for the manifest: `summary`, `times`, and `example`, a case worth a figure.
    """
    times = _times(run)
    tally = run.task.tally(run.source.settings)
    run.folder.merge_parts(run.source.num_chunks, tally.add)
    summary = tally.summary()
    summary["plans_per_second_warm"] = round(times["warm_plans"] / times["warm_seconds"], 1)
    summary["compile_seconds"] = times["compile_seconds"]
    return {"summary": summary, "times": times, "example": tally.example}


def _times(run: SweepRun) -> dict[str, Any]:
    """The times of the manifest, from the records of the parts."""
    seconds = dict.fromkeys(_MEASURED, 0.0)
    warm_plans = 0
    for chunk in range(run.source.num_chunks):
        record = run.folder.part_record(chunk)
        assert record is not None
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
    cases = run.source.chunk(0)
    seconds, warm = 0.0, False
    while not warm:
        _, seconds, warm = _timed_plan(run, cases.scenarios)
    return len(cases), seconds
