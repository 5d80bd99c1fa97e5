"""What interceptions add to a sweep: rows of their own, times and effort, and figures."""

import numpy as np
import pyarrow as pa
from jaxtyping import PyTree

from planner_jax.robot.car import CarPlan
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.summary import COUNTED, Tally
from planner_jax.sweep.figures import CAPTION as MOTION
from planner_jax.sweep.intercept.columns import COLUMNS, FRAME
from planner_jax.sweep.intercept.figures import motion_figure, plane_figure
from planner_jax.sweep.intercept.settings import InterceptSettings
from planner_jax.sweep.rows import car_plan
from planner_jax.sweep.sweep import RunFigure, Sweep, first_values

COMPARED = ("lattice", "spacetime")  # beside a run's own planner, for one case


class InterceptTally(Tally):
    """Sums up when the targets are met, and with how much acceleration, too.

    The example is a success that something that moves comes near to.
    """

    MEANS = ("meeting_time", "miss", "rms_acceleration")
    READS = (*COUNTED, *MEANS, "mover_clearance")
    NEAR = 0.1  # [m]

    def examples(self, rows: pa.Table, success: np.ndarray) -> list[np.ndarray]:
        """Which rows (B,) make examples, the best kind first."""
        is_near = rows["mover_clearance"].to_numpy() < self.NEAR
        return [success & is_near, *super().examples(rows, success)]


class InterceptSweep(Sweep[InterceptSettings]):
    """Cars that meet moving targets among obstacles."""

    frame, own_columns, counts = FRAME, COLUMNS, InterceptTally
    figures = (
        RunFigure(
            "plane.png",
            "Cases of the run from above, two of its failures at most among them. Of one colour is "
            "what is at one time: the car's body and way, and where target and movers are then.",
            (13.0, 8.7),
            plane_figure,
        ),
        RunFigure("motion.png", MOTION, (13.0, 6.8), motion_figure),
        *Sweep.figures,
    )

    def other_planners(self, settings: InterceptSettings) -> Entries:
        """The best that splits path and speed, or the default: each takes a minute to compile."""
        others = super().other_planners(settings)
        return {name: others[name] for name in COMPARED if name in others}

    def setting(self, cases: PyTree) -> Entries:
        """Return map, body and limits that all cases have in common, for the manifest."""
        bounds = first_values(cases, ["lower", "upper"])
        return bounds | first_values(cases.body, prefix="body_") | first_values(cases.limits)

    def plan_of_row(self, row: Row, setting: Entries) -> CarPlan:
        """Return the plan of a row, without the place of the meeting."""
        return car_plan(row)

    def findings(self, manifest: Entries) -> list[str]:
        """Return when targets are met, how closely, and with how much acceleration."""
        summary = manifest["summary"]
        if summary["mean_miss"] is None:
            return []
        return [
            f"Targets are met after {summary['mean_meeting_time']:.2f} s, "
            f"{1e3 * summary['mean_miss']:.2g} mm off, with "
            f"{summary['mean_rms_acceleration']:.3f} m/s² rms acceleration; means of the successes."
        ]

    def remarks(self, manifest: Entries) -> list[str]:
        """Return where the numbers come from, a sentence each."""
        limits = manifest["setting"]
        return [
            *super().remarks(manifest)[:-1],
            f"Limits: speed {limits['speed']:g} m/s, acceleration {limits['acceleration']:g} "
            f"m/s², lateral {limits['lateral_acceleration']:g} m/s², curvature "
            f"{limits['curvature']:g} 1/m, steering rate {limits['steering_rate']:g} rad/s; body "
            f"{limits['body_length']:g} x {limits['body_width']:g} m. Sizes and limits are of a "
            "model car of scale 1:10: an assumption.",
            "A success is the referee's: every limit within 1e-3 relative, the body within 1 mm of "
            "no obstacle at all samples, and its middle within the case's tolerance of the target "
            "at the end.",
        ]
