"""Comparison of sweeps (runs over many cases) by success, cost, speed, and solved cases."""

import csv
import dataclasses
import io
import math
import os
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest

from planner_jax.core.choices import require
from planner_jax.runs.manifest import Entries
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.runs.table import align
from planner_jax.sweep.report import read_finished
from planner_jax.sweep.sweep import settings_of

# Columns of the files of rows that a comparison reads. The runs of every task have these columns.
_READ = ("index", "success", "failed_limit", "cost", "iterations")


@dataclasses.dataclass(frozen=True)
class ComparedRun:
    """A finished run over B cases, with the columns that are compared with other runs."""

    name: str  # path of the run's folder, as the user wrote it
    manifest: Entries
    deciding: tuple[str, ...]  # names of the settings that determine which cases are planned
    index: np.ndarray  # (B,) int, indices of the cases
    success: np.ndarray  # (B,) bool
    failed_limit: np.ndarray  # (B,) str, the first limit that fails; "" for a success
    cost: np.ndarray  # (B,) cost of each plan, which the planner minimises
    iterations: np.ndarray  # (B,) number of the planner's iterations for each plan

    @property
    def settings(self) -> Entries:
        """Settings of the run by name, in which `num` is the number of its cases."""
        return {**self.manifest["parameters"], "num": len(self.index)}

    @property
    def rate(self) -> float:
        """Success rate: number of successful cases divided by the number of cases."""
        return float(self.success.mean())

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper end of Wilson's 95 % confidence interval of the success rate."""
        return wilson_interval(int(self.success.sum()), len(self.success))


class Difference(NamedTuple):
    """Difference between the success of one run and the success of the first listed run."""

    difference: float  # success rate of this run minus the rate of the first run, -1 to 1
    difference_low: float  # lower end of the 95 % confidence interval of the difference
    difference_high: float  # upper end of this interval
    # Number of cases that only the first run solves, number of cases that only this run solves, and
    # the p-value of McNemar's exact test. All three are None if the two runs have different cases.
    first_only: int | None = None
    this_only: int | None = None
    mcnemar_p: float | None = None


def read_run(path: str | os.PathLike) -> ComparedRun:
    """Read a run from its folder; raise `ArgumentError` unless it is a complete, finished sweep."""
    folder = RunFolder(path, name="RUN")
    manifest, sweep = read_finished(folder)
    with folder.reading_rows():
        rows = folder.plans.read(_READ)
    kinds = {"index": int, "success": bool, "failed_limit": str, "cost": float, "iterations": float}
    columns = {name: rows[name].to_numpy().astype(kind) for name, kind in kinds.items()}
    deciding = ("num", "serves", *settings_of(sweep.task).DRAW)
    return ComparedRun(str(path), manifest, deciding, **columns)


def require_comparable(runs: Sequence[ComparedRun]) -> None:
    """Raise `ArgumentError` unless there are several runs of one task, suite and seed."""
    require(len(runs) > 1, "RUN", "the folders of two runs or more", len(runs))
    first = runs[0]
    for other in runs[1:]:
        kinds = ("task", first.manifest["kind"], other.manifest["kind"])
        words = [(n, first.settings.get(n), other.settings.get(n)) for n in ("suite", "seed")]
        for name, mine, theirs in (kinds, *words):
            shown = f"{mine} in {first.name!r} and {theirs} in {other.name!r}"
            require(mine == theirs, "RUN", f"runs of one {name}", shown=shown)


def other_cases(first: ComparedRun, other: ComparedRun) -> list[str]:
    """Return a text "NAME VALUE and VALUE" for each setting by which two runs' cases differ."""
    return _unlike(first, other, first.deciding)


def _unlike(first: ComparedRun, other: ComparedRun, names: Sequence[str]) -> list[str]:
    pairs = [(name, first.settings.get(name), other.settings.get(name)) for name in names]
    return [f"{name} {mine} and {theirs}" for name, mine, theirs in pairs if mine != theirs]


def difference_of(first: ComparedRun, other: ComparedRun) -> Difference:
    """Return the success rate of a run minus the rate of the first run, with a 95 % interval.

    If both runs planned the same cases, McNemar's exact test uses the n cases that exactly one of
    them solves. If the run `other` solves k of these n cases, the interval follows from the
    Clopper-Pearson interval of k / n. For runs of different cases the interval is Newcombe's, from
    the Wilson intervals of both rates.
    """
    change = other.rate - first.rate
    if other_cases(first, other):
        (low, high), (other_low, other_high) = first.interval, other.interval
        below = math.hypot(other.rate - other_low, high - first.rate)
        above = math.hypot(other_high - other.rate, first.rate - low)
        return Difference(change, change - below, change + above)
    mine = int((first.success & ~other.success).sum())
    theirs = int((other.success & ~first.success).sum())
    apart, num = mine + theirs, len(first.success)
    # If both runs solve the same cases, their difference is 0. The runs then differ in 0 of `num`
    # cases. The Clopper-Pearson interval of this rate ends at `reach`, which bounds the difference.
    if not apart:
        reach = float(binomtest(0, num).proportion_ci(0.95, "exact").high)
        return Difference(change, -reach, reach, mine, theirs, 1.0)
    test = binomtest(theirs, apart)
    share = test.proportion_ci(0.95, "exact")
    low, high = ((2.0 * end - 1.0) * apart / num for end in (share.low, share.high))
    return Difference(change, low, high, mine, theirs, float(test.pvalue))


def table_of(runs: Sequence[ComparedRun]) -> list[Entries]:
    """Return success rates, costs and times of each run, and differences from the first run."""
    rows = []
    for index, run in enumerate(runs):
        times, speed = run.manifest["times"], run.manifest["summary"]["plans_per_second_warm"]
        low, high = run.interval
        row = {
            "run": run.name,
            "planner": run.settings.get("planner"),
            "cases": len(run.success),
            "successes": int(run.success.sum()),
            "success_rate": run.rate,
            "wilson_low": low,
            "wilson_high": high,
            "cost_mean": _of(np.mean, run.cost[run.success]),
            "cost_median": _of(np.median, run.cost[run.success]),
            "iterations_mean": _of(np.mean, run.iterations),
            "iterations_median": _of(np.median, run.iterations),
            "plans_per_second": speed,
            "milliseconds_a_plan": 1e3 / speed if speed else None,
            "compile_seconds": times["compile_seconds"],
            "wall_seconds": times["wall_seconds"],
            **dict.fromkeys(Difference._fields),
        }
        rows.append(row | difference_of(runs[0], run)._asdict() if index else row)
    return rows


def _of(measure: Callable[[np.ndarray], np.floating], values: np.ndarray) -> float | None:
    finite = values[np.isfinite(values)]
    return float(measure(finite)) if finite.size else None


def differing(runs: Sequence[ComparedRun]) -> list[tuple[int, list[str]]]:
    """Return, for cases that only some runs solve, the index and each run's failed limit or ""."""
    solved = np.stack([run.success for run in runs])
    places = np.flatnonzero(solved.any(axis=0) & ~solved.all(axis=0))
    index = runs[0].index
    return [(int(index[k]), [str(run.failed_limit[k]) for run in runs]) for k in places]


def describe(runs: Sequence[ComparedRun], most: int | None = 10) -> list[str]:
    """Return the comparison as lines of text; list at most `most` cases that only some solve."""
    first, *others = runs
    own, rows = first.settings, table_of(runs)
    lines = [f"{first.manifest['kind']}, suite {own['suite']}, seed {own['seed']}", ""]
    lines += [f"[{k}] {run.name}" for k, run in enumerate(runs, 1)]
    lines += ["", *align(_cells(rows)), ""]
    for k, (run, row) in enumerate(zip(others, rows[1:], strict=True), 2):
        lines += _sentences(first, run, row, k)
    same = [(k, run) for k, run in enumerate(runs, 1) if not other_cases(first, run)]
    if len(same) < 2:
        return lines
    apart = differing([run for _, run in same])
    if not apart:
        return [*lines, "Every case is solved by all or none of the runs of the same cases."]
    shown = apart[:most]
    lines.append(f"Cases that only some runs solve: {len(apart):,}.")
    header = ["case", *(f"[{k}]" for k, _ in same)]
    listed = [[str(at), *(failed or "success" for failed in fails)] for at, fails in shown]
    lines += align([header, *listed])
    if len(shown) < len(apart):
        lines.append(f"... and {len(apart) - len(shown):,} more; --all lists them.")
    return lines


def _sentences(first: ComparedRun, run: ComparedRun, row: Entries, k: int) -> Iterator[str]:
    low, high = 100.0 * row["difference_low"], 100.0 * row["difference_high"]
    change = f"[{k}] less [1]: {100.0 * row['difference']:+.2f} points of success"
    interval = f"95 % interval {low:+.2f} to {high:+.2f}"
    if cases := other_cases(first, run):
        cases = ", ".join(cases)
        yield f"{change}, {interval}, as of independent runs: the cases differ in {cases}."
        return
    yield (
        f"{change}, {interval}; of the same cases [1] alone solves {row['first_only']:,} and [{k}] "
        f"alone {row['this_only']:,}, p = {row['mcnemar_p']:.3g} (McNemar, exact)."
    )
    # A different batch size is not reported, because it only changes the last digits of plans.
    names = [name for name in first.settings if name not in ("batch", *first.deciding)]
    if settings := _unlike(first, run, names):
        yield f"    settings that differ: {'; '.join(settings)}"


def _cells(rows: Sequence[Entries]) -> list[list[str]]:
    numbers = (
        ("cost of successes, mean", "cost_mean", ".4g"),
        ("cost of successes, median", "cost_median", ".4g"),
        ("iterations, mean", "iterations_mean", ".1f"),
        ("iterations, median", "iterations_median", ".0f"),
        ("plans/s warm", "plans_per_second", ",.0f"),
        ("ms a plan", "milliseconds_a_plan", ".3g"),
        ("compiling [s]", "compile_seconds", ".1f"),
        ("all chunks [s]", "wall_seconds", ".1f"),
    )
    words = ["planner", "cases", "success %", "95 % interval", *(word for word, *_ in numbers)]
    columns = [["", *words]]
    for k, row in enumerate(rows, 1):
        success = percent(row["successes"], row["cases"])
        spread = f"{100.0 * row['wilson_low']:.2f} to {100.0 * row['wilson_high']:.2f}"
        own = [f"[{k}]", str(row["planner"]), f"{row['cases']:,}", success, spread]
        own += ["-" if row[name] is None else format(row[name], form) for _, name, form in numbers]
        columns.append(own)
    return [list(row) for row in zip(*columns, strict=True)]


def as_csv(runs: Sequence[ComparedRun]) -> str:
    """Return the comparison as CSV text with one column for each run.

    The first rows have the quantities that `table_of` returns. Then follows a row for each case
    that only some runs solve, with the first limit that fails in each run, or "success".
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    rows = table_of(runs)
    writer.writerows([name, *(row[name] for row in rows)] for name in rows[0])
    same = [k for k, run in enumerate(runs) if not other_cases(runs[0], run)]
    for at, fails in differing([runs[k] for k in same]):
        words = [""] * len(runs)
        for k, failed in zip(same, fails, strict=True):
            words[k] = failed or "success"
        writer.writerow([f"case {at}", *words])
    return text.getvalue()
