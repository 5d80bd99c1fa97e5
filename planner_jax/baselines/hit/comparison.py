"""Comparison of a quadrotor's success on hits with the results published by [Yu2023bat]."""

import hashlib
from collections import Counter
from typing import cast

import numpy as np
import pyarrow as pa

from planner_jax.baselines.protocols import BY_ROW
from planner_jax.runs.columns import BOOL, Column, RefereedBatch
from planner_jax.runs.manifest import Entries
from planner_jax.runs.summary import COUNTED, Tally
from planner_jax.runs.table import RateTable, rate_cells
from planner_jax.task.hit import court
from planner_jax.task.hit.suites import Serves


def describe_serves(serves: Serves) -> Entries:
    """Return the number of distinct served balls, and the SHA-256 hash of all balls and targets."""
    balls = np.column_stack([serves.position, serves.velocity])
    digest = hashlib.sha256(np.column_stack([balls, serves.target]).tobytes()).hexdigest()
    return {"distinct": len(np.unique(balls, axis=0)), "sha256": digest}


def choose_reference(planner: str) -> str:
    """Return the published planner to compare with: the one that `planner` repeats, else `bat`."""
    name = planner.removesuffix("-fitted")
    return name if name in court.PLANNERS else "bat"


def _outcome_column(index: int, planner: str) -> Column:
    def values(batch: RefereedBatch) -> pa.Array | None:
        if (found := cast(Serves, batch.chunk.origin).published) is None:
            return None
        outcome = found[:, index]
        return pa.array(outcome == 1.0, pa.bool_(), mask=np.isnan(outcome))

    name = f"published_{planner.replace('-', '_')}"
    return Column(name, "", "published outcome; null if there is none", BOOL, values)


OUTCOMES = [_outcome_column(*numbered) for numbered in enumerate(court.PLANNERS)]


class ScenarioTally(Tally):
    """Counts of successes, also of published planners on the run's serves, by scenario."""

    READS = (*COUNTED, "scenario", *(column.name for column in OUTCOMES))

    def __init__(self) -> None:
        super().__init__()
        self._num: Counter[str] = Counter()  # number of cases of each scenario
        self._successes: Counter[str] = Counter()
        self._published: Counter[tuple[str, str]] = Counter()  # successes, by (planner, scenario)
        self._num_published: Counter[tuple[str, str]] = Counter()

    def add(self, rows: pa.Table) -> None:
        """Add rows, one for each planned and judged case, to the counts."""
        super().add(rows)
        scenario = rows["scenario"].to_numpy()
        self._num.update(scenario)
        self._successes.update(scenario[rows["success"].to_numpy().astype(bool)])
        for planner, column in zip(court.PLANNERS, OUTCOMES, strict=True):
            outcome = rows[column.name]
            known = outcome.is_valid().to_numpy().astype(bool)
            solved = outcome.fill_null(False).to_numpy().astype(bool)
            self._num_published.update((planner, name) for name in scenario[known])
            self._published.update((planner, name) for name in scenario[solved])

    def summary(self) -> Entries:
        """Return the counts, and by scenario success rates of the run and published planners."""
        found = {
            name: {
                "num": self._num[name],
                "successes": self._successes[name],
                "success_rate": self._successes[name] / self._num[name],
                "published_on_these_serves": {
                    planner: self._published[planner, name] / self._num_published[planner, name]
                    for planner in court.PLANNERS
                    if self._num_published[planner, name]
                },
            }
            for name in court.SCENARIOS
            if self._num[name]
        }
        return {**super().summary(), "per_scenario": found}


def make_table(manifest: Entries) -> RateTable:
    """Return the run's success in each court scenario [%], beside a published planner's rates."""
    planner, summary = manifest["parameters"]["planner"], manifest["summary"]
    other = choose_reference(planner)
    beside = [
        [BY_ROW["Yu2023bat", table, f"{other} {name}"].value for name in court.SCENARIOS]
        for table in ("Table I", "trial files")
    ]
    header = ["scenario", "cases", f"{planner} %", "95 % interval"]
    header += [f"{other}, paper %", f"{other}, trial files %"]
    same = _knows_same_serves(summary, other)
    header += [f"{other}, same serves %"] if same else []
    rows, known, solved = [], 0, 0.0
    for index, name in enumerate(court.SCENARIOS):
        counts = summary["per_scenario"].get(name)
        own = rate_cells(counts["successes"], counts["num"]) if counts else ["0", "", ""]
        row = [name, *own, *(f"{rates[index]:.1f}" for rates in beside)]
        if same:
            rate = counts["published_on_these_serves"].get(other) if counts else None
            row.append("" if rate is None else f"{100.0 * rate:.1f}")
            if rate is not None:
                known, solved = known + counts["num"], solved + counts["num"] * rate
        rows.append(row)
    total = ["all", *rate_cells(summary["successes"], summary["num"])]
    total += [f"{np.mean(rates):.2f}" for rates in beside]
    total += [f"{100.0 * solved / known:.2f}"] if same else []
    return RateTable("Success per scenario", header, [*rows, total], strong=len(rows))


def explain_table(manifest: Entries) -> str:
    """Return sentences that explain the columns of `make_table` with published success rates."""
    other, same = choose_reference(manifest["parameters"]["planner"]), ""
    if _knows_same_serves(manifest["summary"], other):
        same = '"Same serves" are the published outcomes of this run\'s cases, if known. '
    return (
        f'"{other}, paper" is Table I of the paper, "{other}, trial files" what its published '
        "trial files count over 1,000 rows a scenario. The two differ by up to 20 points; "
        f"their totals are means over the scenarios. {same}"
        "All of these hold for the paper's own setting: full limits, planning from the serve. Here "
        "the iterations of bat-fitted and bat-lite-fitted are fitted to the rates of the files."
    )


def _knows_same_serves(summary: Entries, other: str) -> bool:
    return any(other in c["published_on_these_serves"] for c in summary["per_scenario"].values())
