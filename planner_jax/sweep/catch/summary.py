"""What a catch sweep counts besides successes: catches, their times, and the decision."""

from typing import Any

import numpy as np
import pyarrow as pa

from planner_jax.sweep.summary import Tally

_SOLVED = ("CONVERGED", "FEASIBLE")


class CatchTally(Tally):
    """Counts targets caught, times of the catches and the optimal time ratio too.

    Args:
        decides: whether the planner begins at the decision's times; one that does not has no
            optimal time ratio.
    """

    def __init__(self, decides: bool = True) -> None:
        super().__init__()
        self._decides = decides
        self._shares = self._ratios = self._times = 0.0
        self._num_ratios = self._num_caught = 0

    def add(self, rows: pa.Table) -> None:
        """Count some rows of `plans.parquet`."""
        super().add(rows)
        caught, present, times = (
            np.stack(rows[name].to_pylist()) for name in ("caught", "present", "catch_times")
        )
        self._shares += float((caught.sum(axis=1) / present.sum(axis=1)).sum())
        self._times += float(times[caught].sum())
        self._num_caught += int(caught.sum())
        ratio = rows["time_ratio"].to_numpy()
        known = np.isin(rows["status"].to_numpy(), _SOLVED) & np.isfinite(ratio)
        self._ratios += float(ratio[known].sum())
        self._num_ratios += int(known.sum())

    def summary(self) -> dict[str, Any]:
        """Rates as fractions, 0 to 1, and times [s], for the manifest; None where unknown."""
        num_ratios = self._num_ratios if self._decides else 0
        return {
            **super().summary(),
            "caught": self._shares / self.num,
            "mean_catch_time": _mean(self._times, self._num_caught),
            "optimal_time_ratio": _mean(self._ratios, num_ratios),
        }


def _mean(total: float, num: int) -> float | None:
    return total / num if num else None
