"""Table, figures and page of a run, from nothing but its folder."""

import dataclasses
import math
import shlex
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from planner_jax.runs.parquet import pick_rows, read_rows, row_groups
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.settings import SettingError, settings_of_manifest
from planner_jax.runs.style import draw
from planner_jax.runs.table import headline, to_markdown
from planner_jax.sweep.page import to_page
from planner_jax.sweep.sweep import RunFigure, settings_of, sweep_of_run

PAGE = "index.html"
_CASES_SHOWN = 60
_FAILURES_SHOWN = 12


@dataclasses.dataclass(frozen=True)
class RunRows:
    """What the figures of a run are drawn from."""

    folder: RunFolder
    manifest: dict[str, Any]
    failures: list[dict[str, Any]]  # the first few rows that failed

    def sample(self) -> list[dict[str, Any]]:
        """Rows taken evenly from the run; where nearly all succeed, failures are added."""
        last = self.manifest["summary"]["num"] - 1
        spread = np.linspace(0, last, _CASES_SHOWN).astype(int).tolist()
        shown = pick_rows(self.folder.plans, spread)
        missing = _FAILURES_SHOWN - sum(not row["success"] for row in shown)
        others = [row for row in self.failures if row["index"] not in spread]
        return shown + others[: max(missing, 0)]

    def same_case(self) -> list[tuple[str, dict[str, Any]]]:
        """Planner and row of the run's example, and of the other planners for the same case."""
        own = pick_rows(self.folder.plans, [self.manifest["example"]])[0]
        plans = [(self.manifest["parameters"]["planner"], own)]
        if self.folder.baselines.exists():
            others = read_rows(self.folder.baselines).to_pylist()
            plans += [(row["planner"], row) for row in others]
        return plans

    def columns(self, *names: str) -> pa.Table:
        """Some columns of all rows."""
        return read_rows(self.folder.plans, names)


def require_sound(folder: RunFolder) -> None:
    """Raise `SettingError` unless a sweep's rows are whole, and its summary counts them."""
    manifest = folder.read_manifest()
    sweep = sweep_of_run(manifest, folder.name)
    folder.require_finished(manifest)
    again = f"planner-jax {sweep.kind} --resume --out {shlex.quote(folder.shown)}"
    remedy = f"make it anew: {again}"
    folder.require_whole(manifest, remedy)
    kind = settings_of(sweep.task)
    tally = sweep.tally(settings_of_manifest(kind, manifest["parameters"], folder.name))
    try:
        for _, rows in row_groups(folder.plans):
            tally.add(rows)
        counted = {**tally.summary(), "example": tally.example}
    except (pa.ArrowException, KeyError, ZeroDivisionError) as error:
        rule, why = "a run whose rows can be read", " ".join(str(error).split())
        raise SettingError(f"{folder.name} must be {rule}, got {why}; {remedy}") from None
    require_counted(folder, {**manifest["summary"], "example": manifest.get("example")}, counted)


def require_counted(folder: RunFolder, told: dict[str, Any], counted: dict[str, Any]) -> None:
    """Raise `SettingError` unless a manifest's summary says what its rows do.

    Args:
        folder: of the run.
        told: the summary.
        counted: the same of the rows; entries that are not of rows are missing.
    """
    for name, value in counted.items():
        if not _agree(told.get(name), value):
            rule = f"a run whose {name} is that of its rows, {value}"
            raise SettingError(
                f"{folder.name} must be {rule}, got {told.get(name)} in {folder.shown!r}"
            )


def _agree(one: Any, other: Any) -> bool:
    """Whether two plain values are the same, but for the order in which numbers were added."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_agree(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(_agree, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-4, abs_tol=1e-9) or one != one and other != other
    return one == other


def write_report(folder: RunFolder) -> None:
    """Write `table.md`, `figures/` and `index.html` of a run anew.

    Args:
        folder: with `manifest.json` and `plans.parquet`; `baselines.parquet` may be there.

    Raises:
        SettingError: the folder is not that of a sweep, or the run is not finished.
    """
    manifest = folder.read_manifest()
    sweep = sweep_of_run(manifest, folder.name)
    folder.require_finished(manifest)
    folder.figures.mkdir(exist_ok=True)
    failed = _failed_rows(folder)
    _draw(RunRows(folder, manifest, failed), sweep.figures)
    lines = headline(manifest, sweep.findings(manifest))
    text = to_markdown(sweep.title(manifest), lines, sweep.table(manifest), sweep.remarks(manifest))
    folder.write_text("table.md", text)
    folder.write_text(PAGE, to_page(sweep, manifest, failed))


def rewrite_page(folder: RunFolder, manifest: dict[str, Any]) -> None:
    """Write `index.html` anew with a manifest, where it has been written before."""
    if (folder.path / PAGE).exists():
        page = to_page(sweep_of_run(manifest, folder.name), manifest, _failed_rows(folder))
        folder.write_text(PAGE, page)


def draw_comparisons(folder: RunFolder) -> None:
    """Draw anew the figures that show other planners too, now that they have planned."""
    manifest = folder.read_manifest()
    figures = [f for f in sweep_of_run(manifest, folder.name).figures if f.compares]
    _draw(RunRows(folder, manifest, failures=[]), figures)


def _draw(rows: RunRows, figures: Sequence[RunFigure]) -> None:
    for figure in figures:
        path = rows.folder.figures / figure.name
        draw(path, figure.draw, figure.size, rows)
        rows.folder.sent(path)


def _failed_rows(folder: RunFolder) -> list[dict[str, Any]]:
    """The first failures, a few."""
    failed: list[int] = []
    for first, rows in row_groups(folder.plans, ["success"]):
        failed += (first + np.flatnonzero(~np.asarray(rows["success"]))).tolist()
        if len(failed) >= _FAILURES_SHOWN:
            break
    return pick_rows(folder.plans, failed[:_FAILURES_SHOWN])
