"""The table of a hit run: 36 scenarios beside the published rates, and what the numbers mean."""

from typing import Any

from planner_jax.sweep.hit.figures.rates import compared_with
from planner_jax.sweep.table import RateTable, own_cells
from planner_jax.task.hit import court


def rate_table(manifest: dict[str, Any]) -> RateTable:
    """Success per scenario in percent, beside the published rates of `compared_with`."""
    planner = manifest["parameters"]["planner"]
    other, summary = compared_with(planner), manifest["summary"]
    published, column = court.published_rates(), court.PLANNERS.index(other)
    header = ["scenario", "cases", f"{planner} %", "95 % interval"]
    header += [f"{other}, paper %", f"{other}, trial files %"]
    same = _knows_same_serves(summary, other)
    header += [f"{other}, same serves %"] if same else []
    rows: list[list[str]] = []
    known, solved = 0, 0.0
    for place, name in enumerate(court.SCENARIOS):
        counts = summary["per_scenario"].get(name)
        row = (
            [name, *own_cells(counts["successes"], counts["num"])]
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
    total = ["all", *own_cells(summary["successes"], summary["num"])]
    total += [f"{rates[:, column].mean():.2f}" for rates in (published.paper, published.trials)]
    total += [f"{100.0 * solved / known:.2f}"] if same else []
    return RateTable("Success per scenario", header, [*rows, total], strong=len(rows))


def _knows_same_serves(summary: dict[str, Any], other: str) -> bool:
    """Whether published outcomes of the run's own cases are known."""
    return any(other in c["published_on_these_serves"] for c in summary["per_scenario"].values())


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
    same = ""
    if _knows_same_serves(summary, other):
        same = (
            '"Same serves" are the published outcomes of the very cases of this run, where known. '
        )
    return [
        f"{origin}; {serves['distinct']:,} distinct balls (cases may share a ball and differ in "
        "the target).",
        f"Hover start {start}; planning begins {settings['delay']:g} s after the serve; speed, "
        f"acceleration and body-rate limits x {settings['limit_scale']:g}; returned ball {truth} "
        "drag.",
        "A success is the referee's: every limit within 1e-3 relative, landing within 1 cm.",
        f'"{other}, paper" is Table I of the paper, "{other}, trial files" what its published '
        "trial files count over 1,000 rows a scenario. The two differ by up to 20 points; their "
        f"totals are means over the scenarios. {same}"
        "All of these stand for the paper's own setting: full limits, planning from the serve.",
    ]
