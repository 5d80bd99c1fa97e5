"""Success rates of a sweep, counted row by row from what was written."""

import math
from collections import Counter
from typing import Any

import numpy as np
import pyarrow as pa

from planner_jax.sweep.columns import published_column
from planner_jax.task.hit import court

_NORMAL_QUANTILE = 1.959964  # of 0.975


def wilson_interval(successes: int, num: int) -> tuple[float, float]:
    """The 95 % interval of a success rate after Wilson (1927); stays within 0 and 1.

    Args:
        successes: how many trials succeeded.
        num: of how many; no trial says nothing, (0, 1).
    """
    if num == 0:
        return 0.0, 1.0
    rate, z = successes / num, _NORMAL_QUANTILE
    shrink = 1.0 + z**2 / num
    centre = (rate + z**2 / (2.0 * num)) / shrink
    half = z / shrink * math.sqrt(rate * (1.0 - rate) / num + z**2 / (4.0 * num**2))
    low, high = max(centre - half, 0.0), min(centre + half, 1.0)
    # At the ends the interval closes exactly; rounding must not leave the rate outside.
    return min(low, rate), max(high, rate)


def percent(successes: int, num: int) -> str:
    """A success rate in percent with two decimals; 100 and 0 only where they are exact."""
    rate = 100.0 * successes / num
    if 0 < successes < num:
        rate = min(max(rate, 0.01), 99.99)
    return f"{rate:.2f}"


class Tally:
    """Counts over the rows of a sweep, chunk by chunk; its size does not grow with them."""

    def __init__(self) -> None:
        self.num: Counter[str] = Counter()
        self.successes: Counter[str] = Counter()
        self.status: Counter[str] = Counter()
        self.failed_limits: Counter[str] = Counter()
        self.published: dict[str, Counter[str]] = {name: Counter() for name in court.PLANNERS}
        self.published_num: dict[str, Counter[str]] = {name: Counter() for name in court.PLANNERS}
        # Index of the first success from the left to the far target, as in paper 002, Fig. 7;
        # of the first success, or of the first case, until there is one.
        self.example = 0
        self._example_rank = 3

    def add(self, rows: pa.Table) -> None:
        """Count some rows of `plans.parquet`."""
        scenario = rows["scenario"].to_numpy()
        success = rows["success"].to_numpy().astype(bool)
        self.num.update(scenario)
        self.successes.update(scenario[success])
        self.status.update(rows["status"].to_numpy())
        self.failed_limits.update(rows["failed_limit"].to_numpy()[~success])
        for planner in court.PLANNERS:
            outcome = rows[published_column(planner)]
            known = outcome.is_valid().to_numpy().astype(bool)
            solved = outcome.fill_null(False).to_numpy().astype(bool)
            self.published_num[planner].update(scenario[known])
            self.published[planner].update(scenario[solved])
        self._seek_example(rows["index"].to_numpy(), scenario, success)

    def _seek_example(self, index: np.ndarray, scenario: np.ndarray, success: np.ndarray) -> None:
        """Look for the best example among some rows, unless the best kind is found already."""
        left_to_far = success & np.array([name[0] + name[2] == "LF" for name in scenario])
        for rank, there in enumerate((left_to_far, success, np.ones_like(success))):
            if rank < self._example_rank and there.any():
                self._example_rank, self.example = rank, int(index[there][0])

    def summary(self) -> dict[str, Any]:
        """Rates as fractions, 0 to 1, for the manifest."""
        num, successes = self.num.total(), self.successes.total()
        return {
            "success_rate": successes / num,
            "num": num,
            "successes": successes,
            "wilson_95": list(wilson_interval(successes, num)),
            "status_counts": dict(self.status.most_common()),
            "failed_limits": dict(self.failed_limits.most_common()),
            "per_scenario": {
                name: {
                    "num": self.num[name],
                    "successes": self.successes[name],
                    "success_rate": self.successes[name] / self.num[name],
                    "published_on_these_serves": self._published_rates(name),
                }
                for name in court.SCENARIOS
                if self.num[name]
            },
        }

    def _published_rates(self, scenario: str) -> dict[str, float]:
        """Published rates of a scenario on the very serves of the sweep, where known."""
        return {
            planner: self.published[planner][scenario] / self.published_num[planner][scenario]
            for planner in court.PLANNERS
            if self.published_num[planner][scenario]
        }
