"""What blocks add to a sweep: rows of their own, and how long the arm moves."""

from typing import Any

import pyarrow as pa

from planner_jax.sweep.block.columns import COLUMNS, FRAME
from planner_jax.sweep.settings import SweepSettings
from planner_jax.sweep.summary import Tally
from planner_jax.sweep.sweep import Sweep


class BlockTally(Tally):
    """Sums up how long the arm moves, too."""

    def __init__(self) -> None:
        super().__init__()
        self._execution = 0.0

    def add(self, rows: pa.Table) -> None:
        """Count some rows of `plans.parquet`."""
        super().add(rows)
        success = rows["success"].to_numpy().astype(bool)
        self._execution += float(rows["execution_time"].to_numpy()[success].sum())

    def summary(self) -> dict[str, Any]:
        """Rates as fractions, 0 to 1, and the mean over the successes, None without any."""
        mean = self._execution / self.successes if self.successes else None
        return {**super().summary(), "mean_execution_time": mean}


class BlockSweep(Sweep):
    """Arms that block thrown balls."""

    frame, own_columns = FRAME, COLUMNS

    def tally(self, settings: SweepSettings) -> BlockTally:
        """An empty count of rows."""
        return BlockTally()

    def findings(self, manifest: dict[str, Any]) -> list[str]:
        """How long the arm moves."""
        mean = manifest["summary"]["mean_execution_time"]
        if mean is None:
            return []
        return [f"The arm moves for {mean:.3f} s, in the mean of the successes."]
