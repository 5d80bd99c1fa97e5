"""What blocks add to a sweep: rows of their own, and how long the arm moves."""

from typing import Any

from planner_jax.sweep.block.columns import COLUMNS, FRAME
from planner_jax.sweep.settings import SweepSettings
from planner_jax.sweep.summary import Tally
from planner_jax.sweep.sweep import Sweep


class BlockTally(Tally):
    """Sums up how long the arm moves, too."""

    MEANS = ("execution_time",)


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
