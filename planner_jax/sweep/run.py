"""A sweep: cases in, refereed plans and a report out, in one run folder."""

import contextlib
import dataclasses
import os
import sys
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from planner_jax.core.registry import Task
from planner_jax.host import signals as stopping
from planner_jax.runs.columns import RefereedBatch, rows_of
from planner_jax.runs.environment import require_backend
from planner_jax.runs.parts import Parts
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.settings import (
    SettingError,
    SweepSettings,
    WorkersFailed,
    settings_to_resume,
)
from planner_jax.runs.source import Source
from planner_jax.runs.stored_run import run_folder
from planner_jax.sweep.chunks import SweepRun, plan_chunks
from planner_jax.sweep.cluster import workers_of
from planner_jax.sweep.identity import (
    IDENTITY,
    begun_now,
    identity_of,
    require_same_maker,
    settings_digest,
)
from planner_jax.sweep.report import PAGE, draw_comparisons, rewrite_page, write_report
from planner_jax.sweep.sweep import Sweep, settings_of, sweep_of


class SweepInterrupted(KeyboardInterrupt):
    """A sweep was stopped by hand; its folder, the message, can be resumed."""


def start_sweep(
    task: Task,
    settings: SweepSettings,
    out: str | os.PathLike,
    *,
    progress: bool = True,
    workers: str | None = None,
) -> dict[str, Any]:
    """Plan and referee a sweep into a new folder.

    Args:
        task: that is swept.
        settings: of the sweep, of the task's class.
        out: folder, new or empty; or an address s3://BUCKET/PATH below which nothing lies.
        progress: show a bar on the standard error stream.
        workers: "ray", to have the chunks made by a Ray cluster, on all of its GPUs where JAX
            computes on one here. A row is then that of one device, whatever their number.

    Returns:
        The manifest of the finished run.

    Raises:
        SettingError: an argument or a case breaks a rule; nothing is left behind.
        SweepInterrupted: on Ctrl-C; the folder can be resumed.
        WorkersFailed: workers could not make a chunk; the folder can be resumed.
        OSError: the disk or the store fails; the folder can be resumed.
    """
    folder = run_folder(out)
    folder.require_new()
    sweep, settings = sweep_of(task), settings.of(task)
    with workers_of(workers) as others:
        source = _source(sweep, settings)
        planner = sweep.planner(settings)
        cases = source.check()
        sweep.require_fit(source.settings, planner, cases)
        session, description = begun_now(), source.description()
        identity = identity_of(source, description, session)
        parts = Parts(folder, identity, source)
        manifest = {
            "kind": sweep.kind,
            "state": "running",
            **identity,
            **session,
            "seed": source.settings.seed,
            "parameters": source.settings.parameters(),
            **description,
            "setting": sweep.setting(cases),
            "planner": {"name": source.settings.planner, **_settings_of_planner(planner)},
            "sessions": [_with_workers(session, workers)],
        }
        with folder.created(manifest):
            return _finish(SweepRun(sweep, source, planner, folder, parts, others), progress)


def resume_sweep(
    task: Task,
    out: str | os.PathLike,
    *,
    progress: bool = True,
    workers: str | None = None,
    **given: Any,
) -> dict[str, Any]:
    """Finish a sweep that was interrupted or killed; a whole, finished one is left as it is.

    Parts and rows that are missing, damaged or of another run are planned again.

    Args:
        task: that was swept.
        out: its folder.
        progress: show a bar on the standard error stream.
        workers: as of `start_sweep`, whoever made the chunks that are there.
        **given: settings named again; they must be those of the run.

    Returns:
        The manifest of the finished run, whose rows are those of an uninterrupted one.

    Raises:
        SettingError: the folder is not that of such a sweep, a given setting is not the
            run's, or the cases are not what they were.
        SweepInterrupted: on Ctrl-C; the folder can be resumed.
        WorkersFailed: workers could not make a chunk; the folder can be resumed.
    """
    folder, sweep = run_folder(out), sweep_of(task)
    _settings_of_run(folder, sweep, task, given)
    with workers_of(workers) as others, folder.resumed():
        manifest, settings = _settings_of_run(folder, sweep, task, given)
        damages = folder.damages(manifest)
        if manifest["state"] == "complete" and not damages:
            return manifest
        session = begun_now()
        require_same_maker(manifest, session)
        source = _source(sweep, settings)
        description = source.description()
        for entry, known in description.items():
            if known != manifest.get(entry):
                raise SettingError(f"{entry} must be the same as when the run began")
        if manifest["settings"] != settings_digest(source, description):
            raise SettingError("out must be resumed with the files that its settings named then")
        parts = Parts(folder, {name: manifest[name] for name in IDENTITY}, source)
        parts.require_plain(folder.name)
        for name, why in damages.items():
            print(f"planner-jax: {folder.shown}/{name} is {why}; it is made anew", file=sys.stderr)
        if folder.plans.name in damages:  # the parts are gone since there was a summary
            manifest = {name: value for name, value in manifest.items() if name not in _FOUND}
        sessions = [*manifest["sessions"], _with_workers(session, workers)]
        folder.write_manifest({**manifest, "state": "running", "sessions": sessions})
        planner = sweep.planner(settings)
        return _finish(SweepRun(sweep, source, planner, folder, parts, others), progress)


# What a manifest has of the rows, once they are joined.
_FOUND = ("summary", "times", "example", "files")


def _with_workers(session: dict[str, Any], workers: str | None) -> dict[str, Any]:
    """A session, and who made its chunks unless it was its own process."""
    return session if workers is None else {**session, "workers": workers}


def _settings_of_run(
    folder: RunFolder, sweep: Sweep, task: Task, given: dict[str, Any]
) -> tuple[dict[str, Any], SweepSettings]:
    """Manifest and settings of a run that may be resumed with some settings named again."""
    manifest = folder.read_manifest()
    if manifest["kind"] != sweep.kind:
        raise SettingError(
            f"out must be the folder of a {sweep.kind}, got one of a {manifest['kind']}"
        )
    return manifest, settings_to_resume(settings_of(task), manifest["parameters"], given)


def _source(sweep: Sweep, settings: SweepSettings) -> Source:
    batch = settings.CPU_BATCH if require_backend() == "cpu" else settings.GPU_BATCH
    return sweep.open_source(settings, batch)


def _finish(run: SweepRun, progress: bool) -> dict[str, Any]:
    """Everything that is missing, from the first chunk to the report."""
    folder = run.folder
    try:
        if "summary" not in folder.read_manifest():
            _plan(run, progress)
        folder.remove_parts()
        write_report(folder)
        _add_baselines(run, progress)
        return _end(folder, "complete")
    except KeyboardInterrupt:
        _end(folder, "interrupted")
        raise SweepInterrupted(folder.shown) from None
    except WorkersFailed:
        _end(folder, "interrupted")
        raise
    except OSError:
        with contextlib.suppress(OSError):  # it may be the disk that is full
            _end(folder, "interrupted")
        raise


def _end(folder: RunFolder, state: str) -> dict[str, Any]:
    """Tell on the page, if there is one yet, and in the manifest how a session ended.

    The manifest comes last: a run that is killed in between is resumed, and its page made anew.
    """
    manifest = folder.with_sums({**folder.read_manifest(), "state": state})
    rewrite_page(folder, manifest)
    return folder.write_manifest(manifest)


def _plan(run: SweepRun, progress: bool) -> None:
    """All chunks, joined and counted in the manifest."""
    try:
        found = plan_chunks(run, progress=progress)
    except SettingError:
        # A case that was drawn late breaks a rule, so that this run can never be finished.
        run.folder.discard()
        raise
    run.folder.write_manifest({**run.folder.read_manifest(), **found})


def _add_baselines(run: SweepRun, progress: bool) -> None:
    """Plan one case with the other planners too, and show them beside the run's plan."""
    others = run.sweep.other_planners(run.source.settings)
    if progress and others:
        page = f"{run.folder.shown}/{PAGE}"
        print(f"First figures: {page}. Now one case with the other planners.", file=sys.stderr)
    if others:
        example = run.folder.read_manifest()["example"]
        rows = plan_baselines(run.sweep, run.source, others, example)
        run.folder.write_rows(run.folder.baselines, rows)
        draw_comparisons(run.folder)


def plan_baselines(sweep: Sweep, source: Source, planners: dict[str, Any], index: int) -> pa.Table:
    """Refereed plans of other planners for one case, solved or not.

    Args:
        sweep: of the run.
        source: of its cases.
        planners: by name, one or more.
        index: place of the case in the run.

    Returns:
        The columns of `plans.parquet` behind a column `planner`.
    """
    chunk, tables = source.cases(index, index + 1), []
    for name, planner in planners.items():
        stopping.check()
        plans = sweep.plan(planner, chunk.cases)
        verdict = sweep.judge(chunk.cases, plans, source.settings)
        batch = RefereedBatch(chunk, plans, verdict)
        rows = rows_of(sweep.columns(batch), batch, sweep.frame)
        tables.append(rows.add_column(0, "planner", pa.array([name])))
    return pa.concat_tables(tables)


_OF_NETWORKS = ("parent", "name")  # fields of a Flax module that are none of its sizes


def _settings_of_planner(planner: Any) -> dict[str, Any]:
    """Sizes and switches of a planner, for the manifest; of arrays, their shapes.

    Of a network's weights it is how many there are.
    """
    found = {}
    for field in dataclasses.fields(planner) if dataclasses.is_dataclass(planner) else ():
        value = getattr(planner, field.name)
        if field.name in _OF_NETWORKS and hasattr(planner, "apply"):
            continue
        if dataclasses.is_dataclass(value):
            value = {"class": type(value).__name__, **_settings_of_planner(value)}
        elif isinstance(value, dict):
            value = {"weights": sum(np.size(leaf) for leaf in jax.tree.leaves(value))}
        elif hasattr(value, "shape"):
            value = {"shape": list(value.shape)}
        elif isinstance(value, tuple):
            value = [_settings_of_planner(x) or x for x in value]
        found[field.name] = value
    return found
