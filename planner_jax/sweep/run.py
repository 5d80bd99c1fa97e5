"""Start or resume a sweep: plan and judge many cases, write their rows, and write the report."""

import contextlib
import dataclasses
import datetime
import os
import sys
from collections.abc import Mapping

import jax
import numpy as np
import pyarrow as pa

from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import Planner
from planner_jax.core.registry import Task
from planner_jax.host import signals as stopping
from planner_jax.runs.columns import RefereedBatch, rows_of
from planner_jax.runs.dataset import DamagedPart, check_part, number_of
from planner_jax.runs.environment import environment, makers_of, require_backend
from planner_jax.runs.manifest import Entries
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.settings import SweepSettings, WorkersFailed, settings_to_resume
from planner_jax.runs.source import Source
from planner_jax.runs.timing import Stopwatch
from planner_jax.sweep.chunks import Maker, Record, Workers, make_parts, times_of
from planner_jax.sweep.cluster import workers_of
from planner_jax.sweep.report import count_rows, write_report
from planner_jax.sweep.sweep import Sweep, settings_of, sweep_of


class SweepInterrupted(KeyboardInterrupt):
    """Error: Ctrl-C interrupted a sweep; the message is the path of its folder, to resume it."""


def start_sweep(
    task: Task,
    settings: SweepSettings,
    out: str | os.PathLike,
    *,
    progress: bool = True,
    workers: str | None = None,
) -> Entries:
    """Plan and judge the cases of a sweep, write rows and report, and return the manifest.

    Args:
        task: task of the sweep.
        settings: settings of the sweep, of the class that belongs to the task.
        out: folder of the run, which must be missing or empty.
        progress: whether to show a progress bar on the standard error stream.
        workers: "ray" lets the workers of a Ray cluster plan the chunks of cases, on all its GPUs
            if JAX in this process computes on a GPU. The rows do not depend on the number of
            devices. None plans in this process.

    Raises:
        ArgumentError: an argument or a case is invalid; all files of the run are removed.
        SweepInterrupted: on Ctrl-C; the folder can be resumed.
        WorkersFailed: the workers could not plan a chunk of cases; the folder can be resumed.
        OSError: a file cannot be written; the folder can be resumed.
    """
    folder = RunFolder(out)
    folder.require_new()
    sweep, settings = sweep_of(task), settings.of(task)
    with workers_of(workers) as others:
        maker = _maker_of(sweep, settings)
        source = maker.source
        cases = source.check()
        sweep.require_fit(source.settings, maker.planner, cases)
        session = _session(workers)
        manifest = {
            "kind": sweep.kind,
            "state": "running",
            "run": maker.run,
            **session,
            "makers": maker.makers,
            "seed": source.settings.seed,
            "parameters": source.settings.parameters(),
            **maker.description,
            "setting": sweep.setting(cases),
            "planner": {"name": source.settings.planner, **_fields_of(maker.planner)},
            "sessions": [session],
        }
        with folder.create(manifest):
            try:
                return _finish(folder, manifest, maker, {}, others, progress)
            except ArgumentError:
                # A case is invalid, so the run can never be finished. Its folder is deleted.
                folder.discard()
                raise


def resume_sweep(
    task: Task,
    out: str | os.PathLike,
    *,
    progress: bool = True,
    workers: str | None = None,
    **given: object,
) -> Entries:
    """Finish a sweep that was interrupted or killed, and return the manifest.

    Rows are stored in one file per chunk of cases. The cases of a file that is missing, damaged or
    of another run are planned again. The rows equal the rows of an uninterrupted run.

    The settings `given` by name must equal the run's settings. `progress` shows a progress bar.
    `workers` "ray" plans in a Ray cluster, None in this process, independent of earlier chunks.

    Raises:
        ArgumentError: the folder does not hold a sweep of this task, a given setting differs, or
            rows planned here would differ because of other versions, code, devices or files.
        SweepInterrupted, WorkersFailed, OSError: the run stopped; the folder can be resumed.
    """
    folder, sweep = RunFolder(out), sweep_of(task)
    _settings_of_run(folder, sweep, given)
    with workers_of(workers) as others, folder.lock():
        manifest, settings = _settings_of_run(folder, sweep, given)
        there = _sound_parts(folder, manifest)
        num, batch = settings.num or 1, settings.batch or 1
        is_whole = len(there) == -(-num // batch) and not folder.baselines.damages()
        if manifest["state"] == "complete" and is_whole:
            return manifest
        session = _session(workers)
        for what, old in manifest["makers"].items():
            new, rule = makers_of(session).get(what), f"resumed by {what} {old}, as it started"
            folder.require(new == old, rule, f"{new}; or start again in another folder")
        maker = _maker_of(sweep, settings)
        for entry, known in maker.description.items():
            is_same = known == manifest.get(entry)
            require(is_same, entry, "the same as when the run started", shown="")
        rule = "resumed with the files that its settings named then"
        folder.require(maker.run == manifest["run"], rule, "")
        sessions = [*manifest["sessions"], session]
        manifest = folder.write_manifest({**manifest, "state": "running", "sessions": sessions})
        return _finish(folder, manifest, maker, there, others, progress)


def _session(workers: str | None) -> Entries:
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"started": now, **environment(), **({} if workers is None else {"workers": workers})}


def _settings_of_run(
    folder: RunFolder, sweep: Sweep, given: Mapping[str, object]
) -> tuple[Entries, SweepSettings]:
    manifest = folder.read_manifest()
    kind = manifest["kind"]
    folder.require(kind == sweep.kind, f"the folder of a {sweep.kind}", f"one of a {kind}")
    settings = settings_to_resume(settings_of(sweep.task), manifest["parameters"], dict(given))
    return manifest, settings


def _maker_of(sweep: Sweep, settings: SweepSettings) -> Maker:
    batch = settings.CPU_BATCH if require_backend() == "cpu" else settings.GPU_BATCH
    return Maker.of(sweep, settings, batch)


def _sound_parts(folder: RunFolder, manifest: Entries) -> dict[int, Record]:
    """Return the records of undamaged files of rows, by number, and delete damaged ones.

    If `plans` holds anything that is not named like a part, an error names it, and nothing is
    deleted.
    """
    files, found = {}, {}
    for path in folder.plans.files():
        shown = f"{str(path)!r}, which is not"
        folder.require(path.is_file(), "a run whose parts are regular files", shown)
        try:
            files[path] = number_of(path)
        except DamagedPart as error:
            shown = f"{str(path)!r}, which {error}; move it elsewhere"
            folder.require(False, "a run whose plans holds parts alone", shown)
    for path, number in files.items():
        try:
            record = check_part(path)
            if (record.get("run"), record.get("number")) != (manifest["run"], number):
                raise DamagedPart("is of another run or number")
            if number in found:
                raise DamagedPart("is a duplicate")
            found[number] = record
        except DamagedPart as error:
            print(f"planner-jax: {path} {error}; its cases are planned again", file=sys.stderr)
            path.unlink()
    return found


def _finish(
    folder: RunFolder,
    manifest: Entries,
    maker: Maker,
    there: dict[int, Record],
    workers: Workers | None,
    progress: bool,
) -> Entries:
    source, watch = maker.source, Stopwatch()
    *earlier, session = manifest["sessions"]
    try:
        if progress:
            print(f"Writing {folder.path}; the first chunk compiles.", file=sys.stderr)
        records = make_parts(maker, folder.plans, there, workers, progress)
        session["seconds"] = watch.lap()
        wall = sum(each.get("seconds", 0.0) for each in (*earlier, session))
        times = {**times_of(maker, records), "wall_seconds": round(wall, 4)}
        tally = count_rows(maker.sweep, source.settings, folder.plans)
        summary = {
            **tally.summary(),
            "plans_per_second_warm": round(times["warm_plans"] / times["warm_seconds"], 1),
            "compile_seconds": times["compile_seconds"],
        }
        found = {"summary": summary, "times": times, "example": tally.example}
        manifest = folder.write_manifest({**manifest, **found})
        if others := maker.sweep.other_planners(source.settings):
            if progress:
                print("Now one case with the other planners.", file=sys.stderr)
            folder.baselines.write_rows(plan_baselines(maker.sweep, source, others, tally.example))
        write_report(folder)
        return folder.write_manifest({**manifest, "state": "complete"})
    except (KeyboardInterrupt, WorkersFailed, OSError) as error:
        session.setdefault("seconds", watch.lap())
        # The disk may be full, in which case the manifest cannot be written either.
        with contextlib.suppress(OSError):
            folder.write_manifest({**manifest, "state": "interrupted"})
        if isinstance(error, KeyboardInterrupt):
            raise SweepInterrupted(str(folder.path)) from None
        raise


def plan_baselines(
    sweep: Sweep, source: Source, planners: Mapping[str, Planner], index: int
) -> pa.Table:
    """Plan case `index` with other planners for comparison; return a row for each planner."""
    chunk, tables = source.cases(index, index + 1), []
    for name, planner in planners.items():
        stopping.check()
        plans = sweep.plan(planner, chunk.cases)
        batch = RefereedBatch(chunk, plans, sweep.judge(chunk.cases, plans, source.settings))
        rows = rows_of(sweep.columns(batch), batch, sweep.frame)
        tables.append(rows.add_column(0, "planner", pa.array([name])))
    return pa.concat_tables(tables)


def _fields_of(planner: object) -> Entries:
    found = {}
    for field in dataclasses.fields(planner) if dataclasses.is_dataclass(planner) else ():
        if field.name in ("parent", "name"):
            continue  # every network of Flax has these two fields, which do not describe it
        value = vars(planner)[field.name]
        if dataclasses.is_dataclass(value):
            value = {"class": type(value).__name__, **_fields_of(value)}
        elif isinstance(value, dict):
            value = {"weights": sum(np.size(leaf) for leaf in jax.tree.leaves(value))}
        elif isinstance(value, np.ndarray | jax.Array):
            value = {"shape": list(value.shape)}
        elif isinstance(value, tuple):
            value = [_fields_of(x) or x for x in value]
        found[field.name] = value
    return found
