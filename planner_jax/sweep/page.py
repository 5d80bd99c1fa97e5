"""`index.html` of a run: everything in its folder on one plain page."""

import html
import json
from collections.abc import Sequence
from typing import Any

from planner_jax.runs import table
from planner_jax.sweep.sweep import Sweep

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
.lead { font-size: 1.05rem; } pre { font-size: 0.8rem; overflow-x: auto; background: #f6f8fa;
        padding: 1rem; }
""".strip()


def to_page(sweep: Sweep, manifest: dict[str, Any], failures: Sequence[dict[str, Any]]) -> str:
    """The page of a run.

    Args:
        sweep: that the run is of.
        manifest: of the run.
        failures: some rows of `plans.parquet` that failed.
    """
    title, rates = html.escape(sweep.title(manifest)), sweep.table(manifest)
    lines = table.headline(manifest, sweep.findings(manifest))
    lead = "".join(f"<p class=lead>{html.escape(line)}</p>\n" for line in lines)
    notes = "".join(f"<li>{html.escape(line)}</li>\n" for line in sweep.remarks(manifest))
    figures = "".join(
        f'<figure><a href="figures/{figure.name}"><img src="figures/{figure.name}" '
        f'alt="{figure.caption}"></a>\n<figcaption>{figure.caption}</figcaption></figure>\n'
        for figure in sweep.figures
    )
    record = html.escape(json.dumps(manifest, indent=2))
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
{table.to_html(rates)}</div>
<ul>
{notes}</ul>
{_failures(sweep, manifest, failures)}<h2>The run</h2>
<p>All rows: <a href="plans.parquet">plans.parquet</a> (units in the column metadata); this table:
<a href="table.md">table.md</a>; everything about the run:
<a href="manifest.json">manifest.json</a>.</p>
<details><summary>manifest.json</summary><pre>{record}</pre></details>
</body></html>
"""


def _failures(sweep: Sweep, manifest: dict[str, Any], failures: Sequence[dict[str, Any]]) -> str:
    """The first failures in the referee's words."""
    if not failures:
        return ""
    summary = manifest["summary"]
    words = sweep.failure_words
    rows = [[str(row[column]) for column in words.values()] for row in failures]
    total = summary["num"] - summary["successes"]
    listed = table.RateTable(f"Failures, the first {len(failures)} of {total:,}", list(words), rows)
    return f'<h2>{listed.title}</h2>\n<div class="scroll words">\n{table.to_html(listed)}</div>\n'
