"""Runs over many cases of an arm that blocks a ball, whose flight is known or seen by a camera."""

from collections.abc import Sequence

from jaxtyping import PyTree

from planner_jax.baselines.block.library.adapt import AdaptBlock
from planner_jax.baselines.block.library.planner import LibraryBlock
from planner_jax.core.planner import Planner
from planner_jax.runs.columns import Column, RefereedBatch
from planner_jax.runs.manifest import Entries
from planner_jax.runs.summary import COUNTED, Tally
from planner_jax.studies.block.results import FitErrors, columns_of, describe_fits, follow_study
from planner_jax.studies.block.seeing import SeeingArms
from planner_jax.sweep.block.columns import COLUMNS, FRAME
from planner_jax.sweep.block.settings import BlockSettings
from planner_jax.sweep.rows import arm_plan
from planner_jax.sweep.sweep import Sweep


class BlockTally(Tally):
    """Counts of successes, mean execution time, and errors of flight fits."""

    MEANS, MORE = ("execution_time",), (FitErrors,)
    READS = (*COUNTED, *MEANS, *FitErrors.READS)


class BlockSweep(Sweep[BlockSettings]):
    """Sweeps that plan and judge many cases of an arm that blocks a thrown ball."""

    frame, counts = FRAME, BlockTally
    plan_of_row = staticmethod(arm_plan)

    def columns(self, batch: RefereedBatch) -> Sequence[Column]:
        """Return the columns of the rows, more if a camera is simulated."""
        return [*COLUMNS, *columns_of(batch.plans)]

    def planner(self, settings: BlockSettings) -> Planner:
        """Create the run's planner, wrapped in the simulation of a camera if set."""
        return follow_study(super().planner(settings), settings)

    def other_planners(self, settings: BlockSettings) -> Entries:
        """Return other planners to compare with; none if a camera is simulated."""
        return {} if settings.perception else super().other_planners(settings)

    def require_fit(self, settings: BlockSettings, planner: Planner, cases: PyTree) -> None:
        """Raise if the planner is for another task, or its stored motions for another arm."""
        if isinstance(planner, SeeingArms):
            planner = planner.planner
        super().require_fit(settings, planner, cases)
        if isinstance(planner, LibraryBlock | AdaptBlock):
            planner.check(cases)

    def findings(self, manifest: Entries) -> list[str]:
        """Return sentences on execution time, and on position errors of fitted flights."""
        summary, found = manifest["summary"], []
        if (mean := summary["mean_execution_time"]) is not None:
            found.append(f"The arm moves for {mean:.3f} s, in the mean of the successes.")
        return found + describe_fits(summary)
