"""Additions to a sweep (run over many cases) that simulates a camera or the planning time.

The module wraps the planner, and adds columns, counts and sentences of the report.
"""

import numpy as np
import pyarrow as pa

from planner_jax.baselines.block.library.planner import LibraryBlock
from planner_jax.core.choices import require
from planner_jax.core.planner import Planner
from planner_jax.runs import columns as known
from planner_jax.runs.columns import Column, RefereedBatch, leaves_of
from planner_jax.runs.manifest import Entries
from planner_jax.studies.block.clock import CountedPlanner, TimedPlan
from planner_jax.studies.block.flight_fit import Sight
from planner_jax.studies.block.seeing import SeeingArms, SeenPlan
from planner_jax.studies.block.settings import StudySettings
from planner_jax.task.block.default_planner import OnlineBlock

_ROOM = 0.1  # [m] the summary counts flight fits with at most this position error


# Names of the settings that are passed to `SeeingArms` as keyword arguments.
_SEEING = ("observe", "overhead", "replan", "observe_longer", "noise", "frame_rate", "seed")


def follow_study(planner: Planner, settings: StudySettings) -> Planner:
    """Wrap a planner so that it plans from camera observations, or in measured planning time.

    If the settings simulate neither, the planner is returned unchanged.

    Raises:
        ArgumentError: a camera with the planner `library`, or repeated planning with any planner
            but `online`.
    """
    if settings.perception:
        for name in ("replan", "observe_longer"):
            value = vars(settings)[name]
            may = isinstance(planner, OnlineBlock) or value == 0.0
            require(may, name, "0 for a planner other than online", value)
        own = not isinstance(planner, LibraryBlock)
        require(own, "planner", "one that plans for the individual ball", settings.planner)
        return SeeingArms(planner, **{name: vars(settings)[name] for name in _SEEING})
    if settings.planning_budget is not None:
        return CountedPlanner(planner, settings.planning_budget)
    return planner


def _sights(batch: RefereedBatch) -> np.ndarray:
    names = np.array([Sight(code).name for code in range(len(Sight))])
    return names[np.asarray(batch.plans.sight)]


_SEEN_COLUMNS = [
    Column("sight", "", "outcome of the observation", known.TEXT, _sights),
    *leaves_of(
        "plans",
        ("sightings", "", "frames with the ball until the first fit", known.COUNT),
        ("fit_error", "m", "of the first fit, across the flight midway between the boxes"),
        ("fit_std", "m", "estimated standard deviation of this error"),
        ("last_fit_error", "m", "of the last fit"),
        ("motions", "", "number of started motions", known.COUNT),
    ),
]
_TIMED_COLUMNS = leaves_of("plans", ("planning_time", "s", "of this plan"))


def columns_of(plans: object) -> list[Column]:
    """Return the additional columns of a run's table for plans with camera or timing data."""
    return {SeenPlan: _SEEN_COLUMNS, TimedPlan: _TIMED_COLUMNS}.get(type(plans), [])


class StudyCounts:
    """Position errors of fitted flights, and planning times, collected from the rows of a run.

    Rows of runs that simulate neither a camera nor the planning time add nothing.
    """

    READS = ("fit_error", "planning_time")

    def __init__(self) -> None:
        self._errors, self._seconds = [], []

    def add(self, rows: pa.Table) -> None:
        """Collect fit errors and planning times from rows, one for each case."""
        for name, values in zip(self.READS, (self._errors, self._seconds), strict=True):
            if name in rows.column_names:
                values.append(rows[name].to_numpy())

    def summary(self) -> Entries:
        """Return the fits' median error [m], share of errors <= 0.1 m, and planning times [s]."""
        found = {}
        if self._errors:
            errors = np.concatenate(self._errors)
            seen = errors[np.isfinite(errors)]
            found["fit_error_median"] = float(np.median(seen)) if seen.size else None
            found["fit_within_room"] = float(np.mean(errors <= _ROOM))
        if self._seconds:
            quick, slow = np.quantile(np.concatenate(self._seconds), (0.5, 0.99))
            found |= {"planning_p50": float(quick), "planning_p99": float(slow)}
        return found


def describe_study(summary: Entries) -> list[str]:
    """Return sentences on the errors of flight fits and on planning times, if the run has any."""
    found = []
    if (error := summary.get("fit_error_median")) is not None:
        found.append(
            f"The first fit is {error:.3f} m off across the flight (median), and within "
            f"{_ROOM:g} m for {100.0 * summary['fit_within_room']:.1f} % of the balls."
        )
    if "planning_p50" in summary:
        quick, slow = (1e3 * summary[name] for name in ("planning_p50", "planning_p99"))
        found.append(f"Planning one at a time takes {quick:.1f} ms (p50), {slow:.1f} ms (p99).")
    return found
