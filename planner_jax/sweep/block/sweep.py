"""Runs over many cases of an arm that blocks a thrown ball."""

from jaxtyping import PyTree

from planner_jax.baselines.block.library.planner import LibraryBlock
from planner_jax.core.planner import Planner
from planner_jax.runs.manifest import Entries
from planner_jax.runs.summary import COUNTED, Tally
from planner_jax.sweep.block.columns import COLUMNS, FRAME
from planner_jax.sweep.block.settings import BlockSettings
from planner_jax.sweep.rows import arm_plan
from planner_jax.sweep.sweep import Picture, Sweep
from planner_jax.task.block.drawing import SIZE, draw_plan


class BlockTally(Tally):
    """Counts of successes, and mean execution time."""

    MEANS = ("execution_time",)
    READS = (*COUNTED, *MEANS)


class BlockSweep(Sweep[BlockSettings]):
    """Sweeps that plan and judge many cases of an arm that blocks a thrown ball."""

    frame, counts, own_columns = FRAME, BlockTally, COLUMNS
    plan_of_row = staticmethod(arm_plan)

    def require_fit(self, settings: BlockSettings, planner: Planner, cases: PyTree) -> None:
        """Raise if the planner is for another task, or its stored motions for another arm."""
        super().require_fit(settings, planner, cases)
        if isinstance(planner, LibraryBlock):
            planner.check(cases)

    def setting(self, cases: PyTree) -> Entries:
        """Return the number of joints, which rows need to be read as plans, if it is not six."""
        joints = cases.arm.num
        return super().setting(cases) | ({} if joints == 6 else {"joints": joints})

    def findings(self, manifest: Entries) -> list[str]:
        """Return a sentence on the mean execution time of the successes."""
        if (mean := manifest["summary"]["mean_execution_time"]) is None:
            return []
        return [f"The arm moves for {mean:.3f} s, in the mean of the successes."]

    def pictures(self, case: PyTree, plan: PyTree, verdict: PyTree, planner: str) -> list[Picture]:
        """Return one picture: the arm from above and from the side, and the rates of its joints."""
        return [Picture("block.png", SIZE, lambda figure: draw_plan(case, plan, figure))]
