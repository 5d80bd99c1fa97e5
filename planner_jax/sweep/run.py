"""A sweep: cases in, refereed plans and a report out, in one run folder."""

import dataclasses
import datetime
import os
import sys
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from planner_jax.registry import Task
from planner_jax.sweep.chunks import SweepRun, plan_chunks
from planner_jax.sweep.columns import RefereedBatch, rows_of
from planner_jax.sweep.environment import environment, require_backend
from planner_jax.sweep.report import PAGE, draw_comparisons, rewrite_page, write_report
from planner_jax.sweep.run_folder import RunFolder
from planner_jax.sweep.settings import SettingError, SweepSettings, settings_to_resume
from planner_jax.sweep.source import Source
from planner_jax.sweep.sweep import Sweep, settings_of, sweep_of


class SweepInterrupted(KeyboardInterrupt):
    """A sweep was stopped by hand; its folder, the message, can be resumed."""


def start_sweep(
    task: Task, settings: SweepSettings, out: str | os.PathLike, *, progress: bool = True
) -> dict[str, Any]:
    """Plan and referee a sweep into a new folder.

    Args:
        task: that is swept.
        settings: of the sweep, of the task's class.
        out: folder, new or empty.
        progress: show a bar on the standard error stream.

    Returns:
        The manifest of the finished run.

    Raises:
        SettingError: an argument or a case breaks a rule; nothing is left behind.
        SweepInterrupted: on Ctrl-C; the folder can be resumed.
    """
    folder = RunFolder(out)
    folder.require_new()
    run = _open(sweep_of(task), settings.of(task), folder)
    cases = run.source.check()
    run.sweep.require_fit(run.source.settings, run.planner, cases)
    folder.create(_first_manifest(run, cases))
    return _finish(run, progress)


def resume_sweep(
    task: Task, out: str | os.PathLike, *, progress: bool = True, **given: Any
) -> dict[str, Any]:
    """Finish a sweep that was interrupted or killed; a finished one is left as it is.

    Args:
        task: that was swept.
        out: its folder.
        progress: show a bar on the standard error stream.
        **given: settings named again; they must be those of the run.

    Returns:
        The manifest of the finished run, whose rows are those of an uninterrupted one.

    Raises:
        SettingError: the folder is not that of such a sweep, a given setting is not the
            run's, or the cases are not what they were.
        SweepInterrupted: on Ctrl-C; the folder can be resumed.
    """
    folder = RunFolder(out)
    manifest = folder.read_manifest()
    sweep = sweep_of(task)
    if manifest["kind"] != sweep.kind:
        raise SettingError(
            f"out must be the folder of a {sweep.kind}, got one of a {manifest['kind']}"
        )
    settings = settings_to_resume(settings_of(task), manifest["parameters"], given)
    if manifest["state"] == "complete":
        return manifest
    run = _open(sweep, settings, folder)
    for entry, known in run.source.description().items():
        if known != manifest.get(entry):
            raise SettingError(f"{entry} must be the same as when the run began")
    sessions = [*manifest["sessions"], _session()]
    folder.write_manifest({**manifest, "state": "running", "sessions": sessions})
    return _finish(run, progress)


def _open(sweep: Sweep, settings: SweepSettings, folder: RunFolder) -> SweepRun:
    batch = settings.CPU_BATCH if require_backend() == "cpu" else settings.GPU_BATCH
    return SweepRun(sweep, sweep.open_source(settings, batch), sweep.planner(settings), folder)


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
        raise SweepInterrupted(str(folder.path)) from None


def _end(folder: RunFolder, state: str) -> dict[str, Any]:
    """Tell on the page, if there is one yet, and in the manifest how a session ended.

    The manifest comes last: a run that is killed in between is resumed, and its page made anew.
    """
    manifest = {**folder.read_manifest(), "state": state}
    rewrite_page(folder, manifest)
    folder.write_manifest(manifest)
    return manifest


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
        page = run.folder.path / PAGE
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
        plans = sweep.plan(planner, chunk.cases)
        verdict = sweep.judge(chunk.cases, plans, source.settings)
        batch = RefereedBatch(chunk, plans, verdict)
        rows = rows_of(sweep.columns(batch), batch, sweep.frame)
        tables.append(rows.add_column(0, "planner", pa.array([name])))
    return pa.concat_tables(tables)


def _session() -> dict[str, Any]:
    """When a session began, and where."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"started": now, **environment()}


def _first_manifest(run: SweepRun, cases: Any) -> dict[str, Any]:
    settings, session = run.source.settings, _session()
    return {
        "kind": run.sweep.kind,
        "state": "running",
        **session,
        "seed": settings.seed,
        "parameters": settings.parameters(),
        **run.source.description(),
        "setting": run.sweep.setting(cases),
        "planner": {"name": settings.planner, **_settings_of_planner(run.planner)},
        "sessions": [session],
    }


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
