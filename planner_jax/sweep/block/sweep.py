"""The sweep of blocks: rows, execution times, and results of perception."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from jaxtyping import PyTree

from planner_jax.baselines.block.library.adapt import AdaptBlock
from planner_jax.baselines.block.library.planner import LibraryBlock
from planner_jax.core.choices import require
from planner_jax.core.planner import Planner
from planner_jax.robot.arm import ArmPlan
from planner_jax.runs.columns import Column, RefereedBatch
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.summary import COUNTED, Tally
from planner_jax.studies.block.clock import CountedPlanner, TimedPlan
from planner_jax.studies.block.seeing import SeeingArms, SeenPlan
from planner_jax.sweep.block.columns import COLUMNS, FRAME, SEEN_COLUMNS, TIMED_COLUMNS
from planner_jax.sweep.block.settings import BlockSettings
from planner_jax.sweep.rows import arm_plan
from planner_jax.sweep.sweep import Sweep
from planner_jax.task.block.default_planner import OnlineBlock

_ROOM = 0.1  # [m], tolerance of a contact beside the shield's middle


class BlockTally(Tally):
    """Counts with means of execution time, errors of fits, and planning times."""

    MEANS = ("execution_time",)
    READS = (*COUNTED, *MEANS, "fit_error", "planning_time")  # the last two in some runs only

    def __init__(self) -> None:
        super().__init__()
        self._errors, self._seconds = [], []

    def add(self, rows: pa.Table) -> None:
        """Count some rows of the run."""
        super().add(rows)
        for name, values in (("fit_error", self._errors), ("planning_time", self._seconds)):
            if name in rows.column_names:
                values.append(rows[name].to_numpy())

    def summary(self) -> Entries:
        """Return the summary; with a camera or a clock also errors [m] and times [s]."""
        found = super().summary()
        if self._errors:
            errors = np.concatenate(self._errors)
            seen = errors[np.isfinite(errors)]
            found["fit_error_median"] = float(np.median(seen)) if seen.size else None
            found["fit_within_room"] = float(np.mean(errors <= _ROOM))
        if self._seconds:
            quick, slow = np.quantile(np.concatenate(self._seconds), (0.5, 0.99))
            found |= {"planning_p50": float(quick), "planning_p99": float(slow)}
        return found


class BlockSweep(Sweep[BlockSettings]):
    """Sweeps of arms that block thrown balls."""

    frame, counts = FRAME, BlockTally

    def columns(self, batch: RefereedBatch) -> Sequence[Column]:
        """Return the columns of blocks, with columns of perception or planning time."""
        more = {SeenPlan: SEEN_COLUMNS, TimedPlan: TIMED_COLUMNS}.get(type(batch.plans), [])
        return [*COLUMNS, *more]

    def planner(self, settings: BlockSettings) -> Planner:
        """Return the planner of a run; raise `ArgumentError` if its file is not a library."""
        planner = super().planner(settings)
        if settings.perception:
            for name in ("replan", "observe_longer"):
                value = vars(settings)[name]
                may = isinstance(planner, OnlineBlock) or value == 0.0
                require(may, name, "0 for a planner other than online", value)
            own = not isinstance(planner, LibraryBlock)
            require(own, "planner", "one that plans for the individual ball", settings.planner)
            names = (
                "observe",
                "overhead",
                "replan",
                "observe_longer",
                "noise",
                "frame_rate",
                "seed",
            )
            return SeeingArms(planner, **{name: vars(settings)[name] for name in names})
        if settings.planning_budget is not None:
            return CountedPlanner(planner, settings.planning_budget)
        return planner

    def other_planners(self, settings: BlockSettings) -> Entries:
        """Return the task's other planners; none with perception or a clock."""
        if settings.perception or settings.planning_budget is not None:
            return {}
        return super().other_planners(settings)

    def require_fit(self, settings: BlockSettings, planner: Planner, cases: PyTree) -> None:
        """Raise `ArgumentError` unless the planner takes such cases, and its library fits them."""
        if isinstance(planner, SeeingArms | CountedPlanner):
            planner = planner.planner
        super().require_fit(settings, planner, cases)
        if isinstance(planner, LibraryBlock | AdaptBlock):
            planner.check(cases)

    def plan_of_row(self, row: Row, setting: Entries) -> ArmPlan:
        """Return the plan of a row; it starts when the arm may start, at the row's `delay`."""
        return arm_plan(row)

    def findings(self, manifest: Entries) -> list[str]:
        """Return sentences on execution time, fits of the flight, and planning time."""
        summary, found = manifest["summary"], []
        if (mean := summary["mean_execution_time"]) is not None:
            found.append(f"The arm moves for {mean:.3f} s, in the mean of the successes.")
        if (error := summary.get("fit_error_median")) is not None:
            found.append(
                f"The first fit is {error:.3f} m off across the flight (median), and within "
                f"{_ROOM:g} m for {100.0 * summary['fit_within_room']:.1f} % of the balls."
            )
        if "planning_p50" in summary:
            quick, slow = (1e3 * summary[name] for name in ("planning_p50", "planning_p99"))
            found.append(f"Planning one at a time takes {quick:.1f} ms (p50), {slow:.1f} ms (p99).")
        return found
