"""Table, figures and page of a run, from nothing but its folder."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from planner_jax.sweep.figures.style import draw
from planner_jax.sweep.page import to_page
from planner_jax.sweep.run_folder import RunFolder, pick_rows
from planner_jax.sweep.settings import SettingError
from planner_jax.sweep.sweep import RunFigure, sweep_of_run
from planner_jax.sweep.table import headline, to_markdown

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
            others = pq.read_table(self.folder.baselines).to_pylist()
            plans += [(row["planner"], row) for row in others]
        return plans

    def columns(self, *names: str) -> pa.Table:
        """Some columns of all rows."""
        return pq.read_table(self.folder.plans, columns=list(names))


def write_report(folder: RunFolder) -> None:
    """Write `table.md`, `figures/` and `index.html` of a run anew.

    Args:
        folder: with `manifest.json` and `plans.parquet`; `baselines.parquet` may be there.

    Raises:
        SettingError: the folder is not that of a sweep, or the run is not finished.
    """
    manifest = folder.read_manifest()
    sweep = sweep_of_run(manifest, folder.name)
    if "summary" not in manifest or not folder.plans.exists():
        raise SettingError(
            f"{folder.name} must be finished, got {str(folder.path)!r}; resume it first"
        )
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
        draw(rows.folder.figures / figure.name, figure.draw, figure.size, rows)


def _failed_rows(folder: RunFolder) -> list[dict[str, Any]]:
    """The first failures, a few."""
    failed, first = [], 0
    with pq.ParquetFile(folder.plans) as file:
        for group in range(file.num_row_groups):
            success = file.read_row_group(group, columns=["success"])["success"]
            failed += (first + np.flatnonzero(~np.asarray(success))).tolist()
            first += len(success)
            if len(failed) >= _FAILURES_SHOWN:
                break
    return pick_rows(folder.plans, failed[:_FAILURES_SHOWN])
