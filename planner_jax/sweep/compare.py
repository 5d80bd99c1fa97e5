"""Several runs side by side: rates, costs, speeds, and which cases tell them apart."""

import csv
import dataclasses
import io
import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.stats import binomtest

from planner_jax.core.errors import ArgumentError
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.sweep.report import finished_sweep
from planner_jax.sweep.sweep import settings_of

# Columns of the rows that are read, which all sweeps have.
_READ = ("index", "success", "failed_limit", "cost", "iterations")
# Names of what a `Difference` holds, in the rows of `table_of`.
_DIFFERENCE = ("difference", "difference_low", "difference_high")
_DIFFERENCE += ("first_only", "this_only", "mcnemar_p")


@dataclasses.dataclass(frozen=True)
class ComparedRun:
    """A finished sweep, and of its cases what is compared."""

    name: str  # as it was given
    manifest: dict[str, Any]
    deciding: tuple[str, ...]  # names of the settings that decide the cases
    index: np.ndarray  # (B,) int
    success: np.ndarray  # (B,) bool
    failed: np.ndarray  # (B,) str, the first limit that fails; "" for a success
    cost: np.ndarray  # (B,)
    iterations: np.ndarray  # (B,)

    @property
    def settings(self) -> dict[str, Any]:
        """Those of the run."""
        return self.manifest["parameters"]


@dataclasses.dataclass(frozen=True)
class Difference:
    """How the success of a run differs from that of the first one."""

    difference: float  # of the rates, -1 to 1
    interval: tuple[float, float]  # 95 %
    # Of the same cases: those that the first run alone solves, those that the other alone does, and
    # the chance of as uneven a split if neither were better (McNemar, exact). None otherwise.
    first_only: int | None = None
    other_only: int | None = None
    chance: float | None = None


def read_run(path: str | os.PathLike) -> ComparedRun:
    """A run for `compare`.

    Raises:
        ArgumentError: the folder is not that of a whole, finished sweep.
    """
    folder = RunFolder(path, name="RUN")
    manifest, sweep = finished_sweep(folder)
    try:
        rows = folder.plans.read(_READ)
        found = {name: rows[name].to_numpy() for name in _READ}
    except (pa.ArrowException, KeyError, OSError) as error:
        rule, why = "a run whose rows can be read", " ".join(str(error).split())
        raise ArgumentError(folder.name, rule, shown=why) from None
    return ComparedRun(
        name=str(path),
        manifest=manifest,
        deciding=("num", "serves", *settings_of(sweep.task).DRAW),
        index=found["index"],
        success=found["success"].astype(bool),
        failed=found["failed_limit"].astype(str),
        cost=found["cost"].astype(float),
        iterations=found["iterations"].astype(float),
    )


def require_comparable(runs: Sequence[ComparedRun]) -> None:
    """Raise `ArgumentError` unless there are several runs, of one task, suite and seed."""
    if len(runs) < 2:
        raise ArgumentError("RUN", "the folders of two runs or more", len(runs))
    first = runs[0]
    for other in runs[1:]:
        told = [(run.manifest["kind"], run.settings) for run in (first, other)]
        looks = [("task", *(kind for kind, _ in told))]
        looks += [(name, *(own.get(name) for _, own in told)) for name in ("suite", "seed")]
        for name, mine, theirs in looks:
            if mine != theirs:
                shown = f"{mine} in {first.name!r} and {theirs} in {other.name!r}"
                raise ArgumentError("RUN", f"runs of one {name}", shown=shown)


def other_cases(first: ComparedRun, other: ComparedRun) -> list[str]:
    """Settings in which the cases of two runs differ, as "name VALUE and VALUE"."""
    return _unlike(first, other, first.deciding)


def other_settings(first: ComparedRun, other: ComparedRun) -> list[str]:
    """The other settings in which two runs differ, likewise; `batch` decides no plan's way."""
    names = [name for name in first.settings if name not in ("batch", *first.deciding)]
    return _unlike(first, other, names)


def _unlike(first: ComparedRun, other: ComparedRun, names: Sequence[str]) -> list[str]:
    found = []
    for name in names:
        mine, theirs = (
            len(run.index) if name == "num" else run.settings.get(name) for run in (first, other)
        )
        if mine != theirs:
            found.append(f"{name} {mine} and {theirs}")
    return found


def difference_of(first: ComparedRun, other: ComparedRun) -> Difference:
    """How much more often a run succeeds than the first one.

    Of the same cases only those count that one run alone solves: given how many these are, either
    run is as likely to have each of them if neither is better (McNemar's test, exact), and the
    interval is that of Clopper and Pearson for its share of them. Of other cases the interval is
    Newcombe's, from Wilson's of both rates.
    """
    rates = [float(run.success.mean()) for run in (first, other)]
    change = rates[1] - rates[0]
    if other_cases(first, other):
        (low, high), (other_low, other_high) = (
            wilson_interval(int(run.success.sum()), len(run.success)) for run in (first, other)
        )
        below = math.hypot(rates[1] - other_low, high - rates[0])
        above = math.hypot(other_high - rates[1], rates[0] - low)
        return Difference(change, (change - below, change + above))
    mine = int((first.success & ~other.success).sum())
    theirs = int((other.success & ~first.success).sum())
    apart, num = mine + theirs, len(first.success)
    if not apart:
        # As of no event in so many trials (the rule of three, exact).
        reach = 1.0 - 0.025 ** (1.0 / num)
        return Difference(change, (-reach, reach), mine, theirs, 1.0)
    test = binomtest(theirs, apart)
    share = test.proportion_ci(0.95, "exact")
    low, high = ((2.0 * end - 1.0) * apart / num for end in (share.low, share.high))
    return Difference(change, (low, high), mine, theirs, float(test.pvalue))


def table_of(runs: Sequence[ComparedRun]) -> list[dict[str, Any]]:
    """A row of numbers for every run; those of the difference are empty for the first."""
    rows = []
    for place, run in enumerate(runs):
        num, successes = len(run.success), int(run.success.sum())
        low, high = wilson_interval(successes, num)
        times, speed = run.manifest["times"], run.manifest["summary"]["plans_per_second_warm"]
        cost = run.cost[run.success]
        row = {
            "run": run.name,
            "planner": run.settings.get("planner"),
            "cases": num,
            "successes": successes,
            "success_rate": successes / num,
            "wilson_low": low,
            "wilson_high": high,
            "cost_mean": _of(np.mean, cost),
            "cost_median": _of(np.median, cost),
            "iterations_mean": _of(np.mean, run.iterations),
            "iterations_median": _of(np.median, run.iterations),
            "plans_per_second": speed,
            "milliseconds_a_plan": 1e3 / speed if speed else None,
            "compile_seconds": times["compile_seconds"],
            "wall_seconds": times["wall_seconds"],
            **dict.fromkeys(_DIFFERENCE),
        }
        if place:
            found = difference_of(runs[0], run)
            values = (found.difference, *found.interval, found.first_only, found.other_only)
            row |= dict(zip(_DIFFERENCE, (*values, found.chance), strict=True))
        rows.append(row)
    return rows


def _of(measure: Any, values: np.ndarray) -> float | None:
    """A measure of the finite ones among values, if there are any."""
    finite = values[np.isfinite(values)]
    return float(measure(finite)) if finite.size else None


def differing(runs: Sequence[ComparedRun]) -> list[tuple[int, list[str]]]:
    """The cases that some runs solve and others do not: index, and what fails in each run.

    Args:
        runs: of the same cases.
    """
    solved = np.stack([run.success for run in runs])
    places = np.flatnonzero(solved.any(axis=0) & ~solved.all(axis=0))
    index = runs[0].index
    return [(int(index[k]), [str(run.failed[k]) for run in runs]) for k in places]


def described(runs: Sequence[ComparedRun], most: int | None = 10) -> list[str]:
    """The comparison as lines of text.

    Args:
        runs: that `require_comparable` lets pass.
        most: cases that are listed; None for all.
    """
    first, *others = runs
    own, rows = first.settings, table_of(runs)
    lines = [f"{first.manifest['kind']}, suite {own['suite']}, seed {own['seed']}", ""]
    lines += [f"[{k}] {run.name}" for k, run in enumerate(runs, 1)]
    lines += ["", *_aligned(_cells(rows)), ""]
    for k, (run, row) in enumerate(zip(others, rows[1:], strict=True), 2):
        lines += _told(first, run, row, k)
    same = [(k, run) for k, run in enumerate(runs, 1) if not other_cases(first, run)]
    if len(same) < 2:
        return lines
    apart = differing([run for _, run in same])
    if not apart:
        return [*lines, "Every case ends alike in all runs of the same cases."]
    shown = apart if most is None else apart[:most]
    lines.append(f"Cases that tell them apart: {len(apart):,}.")
    header = ["case", *(f"[{k}]" for k, _ in same)]
    lines += _aligned(
        [header, *([str(at), *(f or "success" for f in fails)] for at, fails in shown)]
    )
    if len(shown) < len(apart):
        lines.append(f"... and {len(apart) - len(shown):,} more; --all lists them.")
    return lines


def _told(first: ComparedRun, run: ComparedRun, row: dict[str, Any], k: int) -> list[str]:
    """How one run differs from the first one."""
    low, high = 100.0 * row["difference_low"], 100.0 * row["difference_high"]
    change = f"[{k}] less [1]: {100.0 * row['difference']:+.2f} points of success"
    interval = f"95 % interval {low:+.2f} to {high:+.2f}"
    if cases := other_cases(first, run):
        told = f"{change}, {interval}, as of independent runs: the cases differ in "
        return [told + ", ".join(cases) + "."]
    told = (
        f"{change}, {interval}; of the same cases [1] alone solves {row['first_only']:,} and [{k}] "
        f"alone {row['this_only']:,}, p = {row['mcnemar_p']:.3g} (McNemar, exact)."
    )
    settings = other_settings(first, run)
    return [told, f"    settings that differ: {'; '.join(settings)}"] if settings else [told]


def _cells(rows: Sequence[dict[str, Any]]) -> list[list[str]]:
    """The table of all runs as text, a line a measure and a column a run."""

    def number(name: str, form: str) -> list[str]:
        return ["-" if row[name] is None else format(row[name], form) for row in rows]

    spread = [
        f"{100.0 * row['wilson_low']:.2f} to {100.0 * row['wilson_high']:.2f}" for row in rows
    ]
    return [
        ["", *(f"[{k}]" for k in range(1, len(rows) + 1))],
        ["planner", *(str(row["planner"]) for row in rows)],
        ["cases", *number("cases", ",")],
        ["success %", *(percent(row["successes"], row["cases"]) for row in rows)],
        ["95 % interval", *spread],
        ["cost of successes, mean", *number("cost_mean", ".4g")],
        ["cost of successes, median", *number("cost_median", ".4g")],
        ["iterations, mean", *number("iterations_mean", ".1f")],
        ["iterations, median", *number("iterations_median", ".0f")],
        ["plans/s warm", *number("plans_per_second", ",.0f")],
        ["ms a plan", *number("milliseconds_a_plan", ".3g")],
        ["compiling [s]", *number("compile_seconds", ".1f")],
        ["all chunks [s]", *number("wall_seconds", ".1f")],
    ]


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Cells as lines, the first column to the left and the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if k == 0 else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def as_csv(runs: Sequence[ComparedRun]) -> str:
    """The comparison as comma-separated text: a column a run, a row a measure or case.

    The rows of cases hold what fails in each run, for all cases that tell runs apart.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    rows = table_of(runs)
    writer.writerows([name, *(row[name] for row in rows)] for name in rows[0])
    same = [k for k, run in enumerate(runs) if not other_cases(runs[0], run)]
    for at, fails in differing([runs[k] for k in same]):
        told = dict(zip(same, fails, strict=True))
        words = (told[k] or "success" if k in told else "" for k in range(len(runs)))
        writer.writerow([f"case {at}", *words])
    return text.getvalue()
