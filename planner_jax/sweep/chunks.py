"""The chunks of a hit sweep: drawn or read, planned, refereed, written and counted."""

import dataclasses
import sys
from collections.abc import Iterable
from typing import Any

import numpy as np
from tqdm import tqdm

from planner_jax.referee.hit import referee_hits
from planner_jax.sweep.columns import RefereedBatch, rows_of
from planner_jax.sweep.run_folder import RunFolder
from planner_jax.sweep.source import ServeSource
from planner_jax.sweep.summary import Tally, percent
from planner_jax.sweep.timing import CompileClock, Stopwatch
from planner_jax.task.hit.scenario import HitScenario
from planner_jax.task.solve import plan

_MEASURED = {
    "compile_seconds": "JAX tracing, lowering, compiling or reading its cache, while chunks were "
    "made; overlapping spans counted once",
    "first_seconds": "the first chunk's plan() call with the compilation in it",
    "warm_seconds": "plan() calls in which nothing was compiled, from scenarios to plans on the "
    "host: ball tables, guesses and all rounds. Where these were less than half a batch, the "
    "first chunk planned again",
    "referee_seconds": "judging, without planning",
    "wall_seconds": "all chunks of all sessions with drawing, checking and writing; without "
    "imports, merging and report",
}


@dataclasses.dataclass(frozen=True)
class HitRun:
    """A hit sweep under way."""

    source: ServeSource
    planner: Any
    folder: RunFolder


def plan_chunks(run: HitRun, *, progress: bool) -> None:
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
            folder.write_part(chunk, rows_of(batch), record)
            done, successes = done + record["num"], successes + record["successes"]
            bar.set_postfix_str(f"success {percent(successes, done)} %", refresh=False)
            bar.update(record["num"])


def _progress(records: Iterable[dict[str, Any]]) -> tuple[int, int]:
    """How many plans some parts hold, and how many of them succeed."""
    done, successes = 0, 0
    for record in records:
        done, successes = done + record["num"], successes + record["successes"]
    return done, successes


def _plan_chunk(run: HitRun, chunk: int) -> tuple[RefereedBatch, dict[str, Any]]:
    """One chunk, and how long it took."""
    source = run.source
    with CompileClock() as clock:
        serves = source.chunk(chunk)
        scenarios = source.scenarios(serves)
        plans, seconds, warm = _timed_plan(run, scenarios)
        watch = Stopwatch()
        drag = source.settings.drag_after_impact
        verdict = referee_hits(scenarios, plans, drag_after_impact=drag)
        referee_seconds = watch.lap()
    record = {
        "num": len(serves),
        "plan_seconds": seconds,
        "warm": warm,
        "compile_seconds": clock.seconds,
        "referee_seconds": referee_seconds,
    }
    return RefereedBatch(serves, scenarios, plans, verdict), record


def _timed_plan(run: HitRun, scenarios: HitScenario) -> tuple[Any, float, bool]:
    """The plans, the seconds they took, and whether nothing was compiled meanwhile."""
    watch = Stopwatch()
    with CompileClock() as clock:
        plans = plan(run.planner, scenarios)
    return plans, watch.lap(), not clock.compiled


def merge_chunks(run: HitRun) -> dict[str, Any]:
    """Join the parts to `plans.parquet`.

    Args:
        run: the sweep, every chunk of it planned.

    Returns:
        Entries for the manifest: `summary`, `times`, and `example`, a case worth a figure.
    """
    times = _times(run)
    tally = Tally()
    run.folder.merge_parts(run.source.num_chunks, tally.add)
    summary = tally.summary()
    summary["plans_per_second_warm"] = round(times["warm_plans"] / times["warm_seconds"], 1)
    summary["compile_seconds"] = times["compile_seconds"]
    return {"summary": summary, "times": times, "example": tally.example}


def _times(run: HitRun) -> dict[str, Any]:
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


def _warm_first_chunk(run: HitRun) -> tuple[int, float]:
    """Number of plans and seconds of the first chunk, planned until nothing is compiled."""
    serves = run.source.chunk(0)
    scenarios = run.source.scenarios(serves)
    seconds, warm = 0.0, False
    while not warm:
        _, seconds, warm = _timed_plan(run, scenarios)
    return len(serves), seconds
