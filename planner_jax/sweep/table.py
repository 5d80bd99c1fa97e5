"""The table of a run: 36 scenarios beside the published rates, and what the numbers mean."""

import html
from typing import Any, NamedTuple

from planner_jax.sweep.figures.rates import compared_with
from planner_jax.sweep.summary import percent, wilson_interval
from planner_jax.task.hit import court


class RateTable(NamedTuple):
    """Text of a table; the last row is that of the totals."""

    header: list[str]
    rows: list[list[str]]


def rate_table(manifest: dict[str, Any]) -> RateTable:
    """Success per scenario in percent, beside the published rates of `compared_with`."""
    planner = manifest["parameters"]["planner"]
    other, summary = compared_with(planner), manifest["summary"]
    published, column = court.published_rates(), court.PLANNERS.index(other)
    header = ["scenario", "cases", f"{planner} %", "95 % interval"]
    header += [f"{other}, paper %", f"{other}, trial files %"]
    same = any(other in c["published_on_these_serves"] for c in summary["per_scenario"].values())
    header += [f"{other}, same serves %"] if same else []
    rows: list[list[str]] = []
    known, solved = 0, 0.0
    for place, name in enumerate(court.SCENARIOS):
        counts = summary["per_scenario"].get(name)
        row = (
            [name, *_own_cells(counts["successes"], counts["num"])]
            if counts
            else [name, "0", "", ""]
        )
        row += [f"{rates[place, column]:.1f}" for rates in (published.paper, published.trials)]
        if same:
            rate = counts["published_on_these_serves"].get(other) if counts else None
            row.append("" if rate is None else f"{100.0 * rate:.1f}")
            if rate is not None:
                known, solved = known + counts["num"], solved + counts["num"] * rate
        rows.append(row)
    total = ["all", *_own_cells(summary["successes"], summary["num"])]
    total += [f"{rates[:, column].mean():.2f}" for rates in (published.paper, published.trials)]
    total += [f"{100.0 * solved / known:.2f}"] if same else []
    return RateTable(header, [*rows, total])


def _own_cells(successes: int, num: int) -> list[str]:
    low, high = wilson_interval(successes, num)
    return [
        f"{num:,}",
        f"{100.0 * successes / num:.2f}",
        f"{100.0 * low:.2f} to {100.0 * high:.2f}",
    ]


def headline(manifest: dict[str, Any]) -> list[str]:
    """Success, speed and failures of a run, a sentence each."""
    summary, times = manifest["summary"], manifest["times"]
    settings, device = manifest["parameters"], manifest["device"]
    low, high = summary["wilson_95"]
    rate = percent(summary["successes"], summary["num"])
    lines = [
        f"Planner {settings['planner']}: {rate} % success, "
        f"{summary['successes']:,} of {summary['num']:,} plans pass the referee "
        f"(95 % interval {100.0 * low:.2f} to {100.0 * high:.2f} %).",
        f"{summary['plans_per_second_warm']:,.0f} plans/s warm, {times['compile_seconds']:.1f} s "
        f"compiling, {times['referee_seconds']:.1f} s judging, {times['wall_seconds']:.1f} s for "
        f"all chunks on {device['kind']} ({device['cpu_count']} CPU cores).",
    ]
    if failed := summary["failed_limits"]:
        reasons = ", ".join(f"{name} {count:,}" for name, count in failed.items())
        lines.append(f"First failed limit of the others: {reasons}.")
    return lines


def remarks(manifest: dict[str, Any]) -> list[str]:
    """Where the numbers come from."""
    summary, settings, serves = manifest["summary"], manifest["parameters"], manifest["serves"]
    other = compared_with(settings["planner"])
    if settings["serves"] is None:
        origin = f"Serves: {summary['num']:,} drawn from the published law, seed {settings['seed']}"
    else:
        origin = f"Serves: {summary['num']:,} cases of published trial files"
    start = settings["start"]
    start = "uniform over the half court, 1.5 m high" if start == "uniform" else f"{tuple(start)} m"
    truth = "with" if settings["drag_after_impact"] else "without"
    return [
        f"{origin}; {serves['distinct']:,} distinct balls (cases may share a ball and differ in "
        "the target).",
        f"Hover start {start}; planning begins {settings['delay']:g} s after the serve; speed, "
        f"acceleration and body-rate limits x {settings['limit_scale']:g}; returned ball {truth} "
        "drag.",
        "A success is the referee's: every limit within 1e-3 relative, landing within 1 cm.",
        f'"{other}, paper" is Table I of the paper, "{other}, trial files" what its published '
        "trial files count over 1,000 rows a scenario. The two differ by up to 20 points; their "
        "totals are means over the scenarios. "
        '"Same serves" are the published outcomes of the very cases of this run, where known. '
        "All of these stand for the paper's own setting: full limits, planning from the serve.",
    ]


def to_markdown(manifest: dict[str, Any]) -> str:
    """The contents of `table.md`."""
    table = rate_table(manifest)
    lines = [f"# Hit sweep, planner {manifest['parameters']['planner']}", ""]
    lines += [line + "  " for line in headline(manifest)]
    lines += ["", _bars(table.header), _bars(["---"] + ["---:"] * (len(table.header) - 1))]
    lines += [_bars(row) for row in table.rows[:-1]]
    lines += [_bars([f"**{cell}**" for cell in table.rows[-1]]), ""]
    lines += [f"- {remark}" for remark in remarks(manifest)]
    return "\n".join(lines) + "\n"


def _bars(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def to_html(table: RateTable) -> str:
    """The table as HTML."""
    rows = [_html_row(table.header, "th"), *(_html_row(row, "td") for row in table.rows)]
    return f"<table>\n{''.join(rows)}</table>\n"


def _html_row(cells: list[str], tag: str) -> str:
    return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>\n"
