"""Success of a hit sweep by scenario, beside the published outcomes."""

from collections import Counter
from typing import Any

import numpy as np
import pyarrow as pa

from planner_jax.sweep.hit.columns import published_column
from planner_jax.sweep.summary import Tally
from planner_jax.task.hit import court


class HitTally(Tally):
    """Counts by scenario too; the example is from the left to the far target (002, Fig. 7)."""

    def __init__(self) -> None:
        super().__init__()
        self.scenario_num: Counter[str] = Counter()
        self.scenario_successes: Counter[str] = Counter()
        self.published: dict[str, Counter[str]] = {name: Counter() for name in court.PLANNERS}
        self.published_num: dict[str, Counter[str]] = {name: Counter() for name in court.PLANNERS}

    def add(self, rows: pa.Table) -> None:
        """Count some rows of `plans.parquet`."""
        super().add(rows)
        scenario = rows["scenario"].to_numpy()
        success = rows["success"].to_numpy().astype(bool)
        self.scenario_num.update(scenario)
        self.scenario_successes.update(scenario[success])
        for planner in court.PLANNERS:
            outcome = rows[published_column(planner)]
            known = outcome.is_valid().to_numpy().astype(bool)
            solved = outcome.fill_null(False).to_numpy().astype(bool)
            self.published_num[planner].update(scenario[known])
            self.published[planner].update(scenario[solved])

    def examples(self, rows: pa.Table, success: np.ndarray) -> list[np.ndarray]:
        """Which rows (B,) make examples, the best kind first."""
        scenario = rows["scenario"].to_numpy()
        left_to_far = success & np.array([name[0] + name[2] == "LF" for name in scenario])
        return [left_to_far, *super().examples(rows, success)]

    def summary(self) -> dict[str, Any]:
        """Rates as fractions, 0 to 1, for the manifest."""
        per_scenario = {
            name: {
                "num": self.scenario_num[name],
                "successes": self.scenario_successes[name],
                "success_rate": self.scenario_successes[name] / self.scenario_num[name],
                "published_on_these_serves": self._published_rates(name),
            }
            for name in court.SCENARIOS
            if self.scenario_num[name]
        }
        return {**super().summary(), "per_scenario": per_scenario}

    def _published_rates(self, scenario: str) -> dict[str, float]:
        """Published rates of a scenario on the very serves of the sweep, where known."""
        return {
            planner: self.published[planner][scenario] / self.published_num[planner][scenario]
            for planner in court.PLANNERS
            if self.published_num[planner][scenario]
        }
