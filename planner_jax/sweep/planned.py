"""Finished sweeps as other commands read them, and the plan of one row."""

import shlex
from typing import Any, NamedTuple

import pyarrow as pa

from planner_jax.core.protocol import Plan, lane
from planner_jax.runs.parquet import pick_rows
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.settings import SettingError, settings_of_manifest
from planner_jax.sweep.sweep import Sweep, settings_of, sweep_of_run


class PlannedRow(NamedTuple):
    """A plan, bit for bit as in the file, and what the referee says against it."""

    plan: Plan  # of its robot's class, such as `QuadrotorPlan`
    sentence: str  # "" where it passes


def finished_sweep(folder: RunFolder) -> tuple[dict[str, Any], Sweep]:
    """The manifest and the sweep of a folder.

    Raises:
        SettingError: the folder is not that of a whole, finished sweep.
    """
    manifest = folder.read_manifest()
    sweep = sweep_of_run(manifest, folder.name)
    folder.require_finished(manifest)
    remedy = f"planner-jax {sweep.kind} --resume --out {shlex.quote(str(folder.path))}"
    folder.require_whole(manifest, f"make it anew: {remedy}")
    return manifest, sweep


def case_of_row(folder: RunFolder, row: int) -> Any:
    """The case of a row, read or drawn again.

    Args:
        folder: of the run.
        row: its place, from 0, one that there is.

    Raises:
        SettingError: the folder is not that of a whole, finished sweep, or the case that is read
            or drawn now is another one.
    """
    manifest, sweep = finished_sweep(folder)
    settings = settings_of_manifest(settings_of(sweep.task), manifest["parameters"], folder.name)
    cases = sweep.open_source(settings.of(sweep.task), 1).cases(row, row + 1).cases
    if sweep.setting(cases) != manifest["setting"]:
        rule = "a run whose cases are drawn or read as they were"
        raise SettingError(f"{folder.name} must be {rule}, got others for row {row}")
    return lane(cases, 0)


def planned_row(folder: RunFolder, row: int | None) -> PlannedRow:
    """The plan of a row, whatever became of it.

    Args:
        folder: of the run.
        row: its place, from 0.

    Raises:
        SettingError: the folder is not that of a whole, finished sweep, or there is no such row.
    """
    manifest, sweep = finished_sweep(folder)
    last = manifest["summary"]["num"] - 1
    if row is None or not 0 <= row <= last:
        shown = "nothing" if row is None else row
        raise SettingError(f"row must be from 0 to {last}, got {shown}")
    try:
        (found,) = pick_rows(folder.plans, [row])
        plan = sweep.plan_of_row(found, manifest.get("setting", {}))
    except (pa.ArrowException, KeyError, TypeError, ValueError) as error:
        rule, why = "a run whose rows can be read", " ".join(str(error).split())
        raise SettingError(f"{folder.name} must be {rule}, got {why}") from None
    if plan is None:
        rule = "a sweep of a task whose rows are read back as plans"
        raise SettingError(f"{folder.name} must be {rule}, got a {sweep.kind}")
    return PlannedRow(plan, found["sentence"])
