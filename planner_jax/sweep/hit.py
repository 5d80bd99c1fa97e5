"""The hit sweep: serves in, refereed plans and a report out, in one run folder."""

import dataclasses
import datetime
import os
import sys
from typing import Any

import numpy as np

from planner_jax.sweep.baselines import plan_baselines
from planner_jax.sweep.chunks import HitRun, merge_chunks, plan_chunks
from planner_jax.sweep.environment import environment, require_backend
from planner_jax.sweep.report import write_report
from planner_jax.sweep.run_folder import RunFolder
from planner_jax.sweep.settings import (
    CPU_BATCH,
    GPU_BATCH,
    HitSweep,
    SettingError,
    settings_to_resume,
)
from planner_jax.sweep.source import open_source
from planner_jax.task.hit.planners import PLANNERS, planner
from planner_jax.task.hit.scenario import HitScenario

KIND = "sweep hit"


class SweepInterrupted(KeyboardInterrupt):
    """A sweep was stopped by hand; its folder, the message, can be resumed."""


def start_hit_sweep(
    settings: HitSweep, out: str | os.PathLike, *, progress: bool = True
) -> dict[str, Any]:
    """Plan and referee a sweep into a new folder.

    Args:
        settings: of the sweep.
        out: folder, new or empty.
        progress: show a bar on the standard error stream.

    Returns:
        The manifest of the finished run.

    Raises:
        SettingError: an argument or a serve breaks a rule; nothing is left behind.
        SweepInterrupted: on Ctrl-C; the folder can be resumed.
    """
    folder = RunFolder(out)
    folder.require_new()
    run = _open(settings, folder)
    source = run.source
    # Of a folder every serve is looked at before anything is written; drawn ones obey their law.
    for chunk in range(source.num_chunks if source.folder is not None else 1):
        scenarios = source.scenarios(source.chunk(chunk))
    folder.create(_first_manifest(run, scenarios))
    return _finish(run, progress)


def resume_hit_sweep(
    out: str | os.PathLike, *, progress: bool = True, **given: Any
) -> dict[str, Any]:
    """Finish a sweep that was interrupted or killed; a finished one is left as it is.

    Args:
        out: its folder.
        progress: show a bar on the standard error stream.
        **given: settings named again; they must be those of the run.

    Returns:
        The manifest of the finished run, whose rows are those of an uninterrupted one.

    Raises:
        SettingError: the folder is not that of a hit sweep, a given setting is not the run's, or
            the folder of serves is not what it was.
        SweepInterrupted: on Ctrl-C; the folder can be resumed.
    """
    folder = RunFolder(out)
    manifest = folder.read_manifest()
    if manifest["kind"] != KIND:
        raise SettingError(f"out must be the folder of a {KIND}, got one of a {manifest['kind']}")
    settings = settings_to_resume(manifest["parameters"], given)
    if manifest["state"] == "complete":
        return manifest
    run = _open(settings, folder)
    if run.source.description() != manifest["serves"]:
        raise SettingError(f"serves must be as they were when the run began, in {settings.serves}")
    sessions = [*manifest["sessions"], _session()]
    folder.write_manifest({**manifest, "state": "running", "sessions": sessions})
    return _finish(run, progress)


def _open(settings: HitSweep, folder: RunFolder) -> HitRun:
    batch = CPU_BATCH if require_backend() == "cpu" else GPU_BATCH
    chosen = planner(settings.planner, **settings.planner_options())
    return HitRun(source=open_source(settings, batch), planner=chosen, folder=folder)


def _finish(run: HitRun, progress: bool) -> dict[str, Any]:
    """Everything that is missing, from the first chunk to the report."""
    folder = run.folder
    try:
        if "summary" not in folder.read_manifest():
            _plan(run, progress)
        folder.remove_parts()
        write_report(folder)
        _add_baselines(run, progress)
        manifest = {**folder.read_manifest(), "state": "complete"}
        folder.write_manifest(manifest)
    except KeyboardInterrupt:
        folder.write_manifest({**folder.read_manifest(), "state": "interrupted"})
        raise SweepInterrupted(str(folder.path)) from None
    return manifest


def _plan(run: HitRun, progress: bool) -> None:
    """All chunks, merged and counted in the manifest."""
    try:
        plan_chunks(run, progress=progress)
    except SettingError:
        # A serve that was drawn late breaks a rule, so that this run can never be finished.
        run.folder.discard()
        raise
    found = merge_chunks(run)
    run.folder.write_manifest({**run.folder.read_manifest(), **found})


def _add_baselines(run: HitRun, progress: bool) -> None:
    """Plan one case with the other planners too, and show them beside the run's plan."""
    if progress and len(PLANNERS) > 1:
        page = run.folder.path / "index.html"
        print(f"First figures: {page}. Now one serve with the other planners.", file=sys.stderr)
    rows = plan_baselines(run.source, run.folder.read_manifest()["example"])
    if rows is not None:
        run.folder.write_rows(run.folder.baselines, rows)
        write_report(run.folder)


def _session() -> dict[str, Any]:
    """When a session began, and where."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"started": now, **environment()}


def _first_manifest(run: HitRun, scenarios: HitScenario) -> dict[str, Any]:
    settings, session = run.source.settings, _session()
    return {
        "kind": KIND,
        "state": "running",
        **session,
        "seed": settings.seed,
        "parameters": settings.parameters(),
        "serves": run.source.description(),
        "setting": _setting(scenarios),
        "planner": {"name": settings.planner, **dataclasses.asdict(run.planner)},
        "sessions": [session],
    }


def _setting(scenarios: HitScenario) -> dict[str, Any]:
    """What all scenarios have in common: physics and limits, from the first one."""

    def first(tree: Any, names: list[str]) -> dict[str, Any]:
        # Six digits, so that float32 does not show.
        leaves = {name: np.asarray(getattr(tree, name), float)[0] for name in names}
        return {name: leaf.round(6).tolist() for name, leaf in leaves.items()}

    setting = first(scenarios, ["drag", "gravity", "restitution", "racket_height"])
    for group in (scenarios.limits, scenarios.hit_limits):
        setting |= first(group, [field.name for field in dataclasses.fields(group)])
    return setting
