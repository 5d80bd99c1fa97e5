"""The table of success rates in a report, as text, Markdown and HTML, and the report's headline."""

import html
from collections.abc import Sequence
from typing import NamedTuple

from planner_jax.runs.manifest import Entries
from planner_jax.runs.summary import percent, wilson_interval


class RateTable(NamedTuple):
    """A table of success rates whose cells are text."""

    title: str
    header: list[str]  # headings of the columns
    rows: list[list[str]]
    strong: int | None = None  # index of the row that is set in bold


def rate_cells(successes: int, num: int) -> list[str]:
    """Return three cells: number of cases, success rate [%], and its 95 % Wilson interval [%]."""
    low, high = wilson_interval(successes, num)
    interval = f"{100.0 * low:.2f} to {100.0 * high:.2f}"
    return [f"{num:,}", f"{100.0 * successes / num:.2f}", interval]


def align(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a line of text for each row, with the first column flush left, the others right."""
    first, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    cells = [[row[0].ljust(first), *map(str.rjust, row[1:], widths)] for row in rows]
    return ["  ".join(line).rstrip() for line in cells]


def headline(manifest: Entries, findings: Sequence[str] = ()) -> list[str]:
    """Return a report's first sentences: success rate, `findings`, speed, failed limits.

    `findings` are sentences on results of one task. A failed limit, such as the greatest speed, is
    the first limit that a rejected plan breaks; the last sentence counts them.
    """
    summary, times = manifest["summary"], manifest["times"]
    settings, device = manifest["parameters"], manifest["device"]
    low, high = summary["wilson_95"]
    rate = percent(summary["successes"], summary["num"])
    lines = [
        f"Planner {settings['planner']}: {rate} % success, "
        f"{summary['successes']:,} of {summary['num']:,} plans pass the referee "
        f"(95 % interval {100.0 * low:.2f} to {100.0 * high:.2f} %).",
        *findings,
        f"{summary['plans_per_second_warm']:,.0f} plans/s warm, {times['compile_seconds']:.1f} s "
        f"compiling, {times['referee_seconds']:.1f} s judging, {times['wall_seconds']:.1f} s for "
        f"all chunks on {device['kind']} ({device['cpu_count']} CPU cores).",
    ]
    if failed := summary["failed_limits"]:
        reasons = ", ".join(f"{name} {count:,}" for name, count in failed.items())
        lines.append(f"First failed limit of the others: {reasons}.")
    return lines


def to_markdown(title: str, lines: Sequence[str], table: RateTable, remarks: Sequence[str]) -> str:
    """Return the Markdown text of `table.md`: title, headline, table and remarks."""
    text = [f"# {title}", "", *(line + "  " for line in lines), ""]
    text += [_bars(table.header), _bars(["---"] + ["---:"] * (len(table.header) - 1))]
    for index, row in enumerate(table.rows):
        strong = index == table.strong
        text.append(_bars([f"**{cell}**" if strong and cell else cell for cell in row]))
    text += ["", *(f"- {remark}" for remark in remarks)]
    return "\n".join(text) + "\n"


def _bars(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def to_html(table: RateTable) -> str:
    """Return the HTML element of a table, without the table's title."""
    rows = [_html_row(table.header, "th")]
    for index, row in enumerate(table.rows):
        rows.append(_html_row(row, "td", " class=strong" if index == table.strong else ""))
    return f"<table>\n{''.join(rows)}</table>\n"


def _html_row(cells: Sequence[str], tag: str, mark: str = "") -> str:
    inner = "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells)
    return f"<tr{mark}>{inner}</tr>\n"
