"""Table, figures and page of a run, from nothing but its folder."""

from typing import Any

import numpy as np
import pyarrow.parquet as pq

from planner_jax.sweep.figures.court import court_figure
from planner_jax.sweep.figures.motion import motion_figure
from planner_jax.sweep.figures.rates import rates_figure
from planner_jax.sweep.figures.style import draw
from planner_jax.sweep.page import to_page
from planner_jax.sweep.run_folder import RunFolder, pick_rows
from planner_jax.sweep.settings import SettingError
from planner_jax.sweep.table import to_markdown

_CASES_SHOWN = 60
_FAILURES_SHOWN = 12


def write_report(folder: RunFolder) -> None:
    """Write `table.md`, `figures/` and `index.html` of a run anew.

    Args:
        folder: with `manifest.json` and `plans.parquet`; `baselines.parquet` may be there.

    Raises:
        SettingError: the folder is not that of a run, or the run is not finished.
    """
    manifest = folder.read_manifest()
    if "summary" not in manifest or not folder.plans.exists():
        raise SettingError(
            f"{folder.name} must be finished, got {str(folder.path)!r}; resume it first"
        )
    folder.figures.mkdir(exist_ok=True)
    failed = pick_rows(folder.plans, _first_failures(folder))
    spread = np.linspace(0, manifest["summary"]["num"] - 1, _CASES_SHOWN).astype(int).tolist()
    shown = pick_rows(folder.plans, spread)
    # Where nearly all succeed, an even sample would show no failure.
    missing = _FAILURES_SHOWN - sum(not row["success"] for row in shown)
    shown += [row for row in failed if row["index"] not in spread][: max(missing, 0)]
    setting = manifest["setting"]
    drag_after = manifest["parameters"]["drag_after_impact"]
    draw(folder.figures / "court.png", court_figure, (9.0, 10.6), shown, setting, drag_after)
    draw(folder.figures / "motion.png", motion_figure, (13.0, 6.8), _same_serve(folder), setting)
    draw(folder.figures / "rates.png", rates_figure, (13.0, 6.6), manifest)
    folder.write_text("table.md", to_markdown(manifest))
    folder.write_text("index.html", to_page(manifest, failed))


def _first_failures(folder: RunFolder) -> list[int]:
    """Rows of the first failures, a few."""
    failed, first = [], 0
    with pq.ParquetFile(folder.plans) as file:
        for group in range(file.num_row_groups):
            success = file.read_row_group(group, columns=["success"])["success"]
            failed += (first + np.flatnonzero(~np.asarray(success))).tolist()
            first += len(success)
            if len(failed) >= _FAILURES_SHOWN:
                break
    return failed[:_FAILURES_SHOWN]


def _same_serve(folder: RunFolder) -> list[tuple[str, dict[str, Any]]]:
    """Planner and row of the run's example, and of the other planners for the same serve."""
    manifest = folder.read_manifest()
    own = pick_rows(folder.plans, [manifest["example"]])[0]
    plans = [(manifest["parameters"]["planner"], own)]
    if folder.baselines.exists():
        others = pq.read_table(folder.baselines).to_pylist()
        plans += [(row["planner"], row) for row in others]
    return plans
