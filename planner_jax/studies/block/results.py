"""Additions to a sweep (run over many cases) that simulates a camera.

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
from planner_jax.studies.block.flight_fit import Sight
from planner_jax.studies.block.seeing import SeeingArms, SeenPlan
from planner_jax.studies.block.settings import StudySettings
from planner_jax.task.block.default_planner import OnlineBlock

_ROOM = 0.1  # [m] the summary counts flight fits with at most this position error


# Names of the settings that are passed to `SeeingArms` as keyword arguments.
_SEEING = ("observe", "overhead", "replan", "noise", "frame_rate", "seed")


def follow_study(planner: Planner, settings: StudySettings) -> Planner:
    """Wrap a planner so that it plans from camera observations.

    If the settings simulate no camera, the planner is returned unchanged.

    Raises:
        ArgumentError: a camera with the planner `library`, or repeated planning with any planner
            but `online`.
    """
    if settings.perception:
        may = isinstance(planner, OnlineBlock) or settings.replan == 0.0
        require(may, "replan", "0 for a planner other than online", settings.replan)
        own = not isinstance(planner, LibraryBlock)
        require(own, "planner", "one that plans for the individual ball", settings.planner)
        return SeeingArms(planner, **{name: vars(settings)[name] for name in _SEEING})
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


def columns_of(plans: object) -> list[Column]:
    """Return the additional columns of a run's table for plans with camera data."""
    return _SEEN_COLUMNS if isinstance(plans, SeenPlan) else []


class FitErrors:
    """Position errors of fitted flights, collected from the rows of a run.

    Rows of runs that simulate no camera add nothing.
    """

    READS = ("fit_error",)

    def __init__(self) -> None:
        self._errors = []

    def add(self, rows: pa.Table) -> None:
        """Collect fit errors from rows, one for each case."""
        if "fit_error" in rows.column_names:
            self._errors.append(rows["fit_error"].to_numpy())

    def summary(self) -> Entries:
        """Return the fits' median error [m], and their share of errors <= 0.1 m."""
        if not self._errors:
            return {}
        errors = np.concatenate(self._errors)
        seen = errors[np.isfinite(errors)]
        return {
            "fit_error_median": float(np.median(seen)) if seen.size else None,
            "fit_within_room": float(np.mean(errors <= _ROOM)),
        }


def describe_fits(summary: Entries) -> list[str]:
    """Return a sentence on the errors of flight fits, if the run simulated a camera."""
    if (error := summary.get("fit_error_median")) is None:
        return []
    return [
        f"The first fit is {error:.3f} m off across the flight (median), and within "
        f"{_ROOM:g} m for {100.0 * summary['fit_within_room']:.1f} % of the balls."
    ]
