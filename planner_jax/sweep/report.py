"""Report of a finished run over many cases: table, figures and HTML page, from its folder."""

import html
import math
import shlex
from collections.abc import Mapping, Sequence

import numpy as np

from planner_jax.runs.dataset import Dataset
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.run_folder import FAILURES_SHOWN, RunFolder, RunRows
from planner_jax.runs.settings import SweepSettings, settings_of_manifest
from planner_jax.runs.style import draw
from planner_jax.runs.summary import Tally
from planner_jax.runs.table import RateTable, headline, to_html, to_markdown
from planner_jax.sweep.sweep import Sweep, settings_of, sweep_of_run


def count_rows(sweep: Sweep, settings: SweepSettings, rows: Dataset) -> Tally:
    """Count successes, statuses and failed limits over all rows of a run, one file at a time."""
    tally = sweep.tally(settings)
    for part in rows.parts(tally.READS or None):
        tally.add(part)
    return tally


def read_finished(folder: RunFolder) -> tuple[Entries, Sweep]:
    """Return a run's manifest and `Sweep`; raise `ArgumentError` if it is unfinished or damaged."""
    manifest = folder.read_manifest()
    sweep = sweep_of_run(manifest, folder.name)
    folder.require("summary" in manifest, "finished", f"{str(folder.path)!r}; resume it first")
    again = f"planner-jax {sweep.kind} --resume --out {shlex.quote(str(folder.path))}"
    remedy = f"make it anew: {again}"
    folder.require_whole(folder.plans, remedy, manifest["summary"]["num"])
    folder.require_whole(folder.baselines, remedy)
    return manifest, sweep


def require_sound(folder: RunFolder) -> None:
    """Raise `ArgumentError` unless all rows exist and their counts equal the manifest's summary."""
    manifest, sweep = read_finished(folder)
    settings = settings_of_manifest(settings_of(sweep.task), manifest["parameters"], folder.name)
    with folder.reading_rows():
        tally = count_rows(sweep, settings, folder.plans)
        counted = {**tally.summary(), "example": tally.example}
    require_counted(folder, {**manifest["summary"], "example": manifest.get("example")}, counted)


def require_counted(folder: RunFolder, summary: Mapping[str, object], counted: Entries) -> None:
    """Raise `ArgumentError` unless a manifest's summary agrees with the counts of the rows."""
    for name, value in counted.items():
        rule = f"a run whose entry {name} agrees with its rows, {value}"
        shown = f"{summary.get(name)} in {str(folder.path)!r}"
        folder.require(_agree(summary.get(name), value), rule, shown)


def _agree(one: object, other: object) -> bool:
    """Return whether two JSON values are equal, floats within a relative difference of 1e-4."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_agree(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(_agree, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-4, abs_tol=1e-9) or one != one and other != other
    return one == other


def write_report(folder: RunFolder) -> None:
    """Write `table.md`, `figures/` and `index.html` into the folder of a finished run."""
    manifest = folder.read_manifest()
    sweep = sweep_of_run(manifest, folder.name)
    folder.figures.mkdir(exist_ok=True)
    failed = _pick_failures(folder.plans)
    rows = RunRows(folder, manifest, failed)
    for figure in sweep.figures:
        draw(folder.figures / figure.name, figure.draw, figure.size, rows)
    title, table, remarks = sweep.title(manifest), sweep.table(manifest), sweep.remarks(manifest)
    lines = headline(manifest, sweep.findings(manifest))
    folder.write_text("table.md", to_markdown(title, lines, table, remarks))
    folder.write_text("index.html", _page(sweep, manifest, lines, failed))


def _pick_failures(plans: Dataset) -> list[Row]:
    failed, first = [], 0
    for rows in plans.parts(["success"]):
        failed += (first + np.flatnonzero(~np.asarray(rows["success"]))).tolist()
        first += len(rows)
        if len(failed) >= FAILURES_SHOWN:
            break
    return plans.pick(failed[:FAILURES_SHOWN])


_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #24292f; max-width: 68rem; margin: 2rem auto;
       padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
img { max-width: 100%; max-height: 56rem; }
figure { margin: 1rem 0; } figcaption { color: #57606a; font-size: 0.9rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.9rem; }
th, td { padding: 0.2rem 0.8rem; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
.words td { text-align: left; white-space: normal; }
tr { border-bottom: 1px solid #e6e8eb; } th { border-bottom: 2px solid #8a8f98; }
.rates tr.strong { font-weight: bold; background: #f0f4f8; }
.lead { font-size: 1.05rem; }
""".strip()


def _page(sweep: Sweep, manifest: Entries, lines: Sequence[str], failures: Sequence[Row]) -> str:
    title, rates = html.escape(sweep.title(manifest)), sweep.table(manifest)
    lead = "".join(f"<p class=lead>{html.escape(line)}</p>\n" for line in lines)
    notes = "".join(f"<li>{html.escape(line)}</li>\n" for line in sweep.remarks(manifest))
    figures = "".join(
        f'<figure><a href="figures/{figure.name}"><img src="figures/{figure.name}" '
        f'alt="{figure.caption}"></a>\n<figcaption>{figure.caption}</figcaption></figure>\n'
        for figure in sweep.figures
    )
    listed = ""
    if failures:
        summary, words = manifest["summary"], sweep.failure_words
        rows = [[str(row[column]) for column in words.values()] for row in failures]
        total = summary["num"] - summary["successes"]
        table = to_html(RateTable("", list(words), rows))
        listed = f"<h2>Failures, the first {len(failures)} of {total:,}</h2>\n"
        listed += f'<div class="scroll words">\n{table}</div>\n'
    return f"""<!doctype html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>
{_STYLE}
</style></head>
<body>
<h1>{title}</h1>
{lead}{figures}<h2>{rates.title}</h2>
<div class="scroll rates">
{to_html(rates)}</div>
<ul>
{notes}</ul>
{listed}<h2>The run</h2>
<p>All rows: the Parquet dataset <a href="plans/">plans/</a> (units in the column metadata); this
table: <a href="table.md">table.md</a>; everything about the run:
<a href="manifest.json">manifest.json</a>.</p>
</body></html>
"""
