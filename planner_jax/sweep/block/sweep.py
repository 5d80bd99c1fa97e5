"""What blocks add to a sweep: rows of their own, and how long the arm moves."""

from typing import Any

from planner_jax.sweep.block.columns import COLUMNS, FRAME
from planner_jax.sweep.settings import SettingError, SweepSettings
from planner_jax.sweep.summary import Tally
from planner_jax.sweep.sweep import Sweep
from planner_jax.task.block.library.adapt import AdaptBlock
from planner_jax.task.block.library.file import LibraryFileError
from planner_jax.task.block.library.planner import LibraryBlock, OtherLibrary


class BlockTally(Tally):
    """Sums up how long the arm moves, too."""

    MEANS = ("execution_time",)


class BlockSweep(Sweep):
    """Arms that block thrown balls."""

    frame, own_columns = FRAME, COLUMNS

    def planner(self, settings: SweepSettings) -> Any:
        """The planner of a run; `SettingError` where its file is no library."""
        try:
            return super().planner(settings)
        except LibraryFileError as error:
            raise SettingError(str(error)) from None

    def require_fit(self, settings: SweepSettings, planner: Any, cases: Any) -> None:
        """Raise `SettingError` unless the planner is one of such cases, and a library of these."""
        super().require_fit(settings, planner, cases)
        if isinstance(planner, LibraryBlock | AdaptBlock):
            try:
                planner.check(cases)
            except OtherLibrary as error:
                raise SettingError(str(error)) from None

    def tally(self, settings: SweepSettings) -> BlockTally:
        """An empty count of rows."""
        return BlockTally()

    def findings(self, manifest: dict[str, Any]) -> list[str]:
        """How long the arm moves."""
        mean = manifest["summary"]["mean_execution_time"]
        if mean is None:
            return []
        return [f"The arm moves for {mean:.3f} s, in the mean of the successes."]
