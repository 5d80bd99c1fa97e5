"""What interceptions add to a sweep: rows of their own, times and effort, and figures."""

from typing import Any

import numpy as np
import pyarrow as pa

from planner_jax.robot.car import CarPlan
from planner_jax.runs.summary import COUNTED, Tally
from planner_jax.sweep.figures.motion import CAPTION as MOTION
from planner_jax.sweep.figures.outcomes import outcomes_figure
from planner_jax.sweep.intercept.columns import COLUMNS, FRAME
from planner_jax.sweep.intercept.figures.motion import motion_figure
from planner_jax.sweep.intercept.figures.plane import plane_figure
from planner_jax.sweep.intercept.figures.reach import reach_figure
from planner_jax.sweep.intercept.figures.station_time import station_time_figure
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


class InterceptSweep(Sweep):
    """Cars that meet moving targets among obstacles."""

    frame, own_columns = FRAME, COLUMNS
    figures = (
        RunFigure(
            "plane.png",
            "Cases of the run from above, two of its failures at most among them. Of one colour is "
            "what is at one time: the car's body and way, and where target and movers are then.",
            (13.0, 8.7),
            plane_figure,
        ),
        RunFigure(
            "station_time.png",
            "One plan along its own way: what the movers block of it and when, the plan's station, "
            "speed and acceleration, and what speed steps of paper 003 make of the same way.",
            (13.0, 6.4),
            station_time_figure,
        ),
        RunFigure(
            "reach.png",
            "Where the car can be, and when, in the same case: the cells that the reach set of the "
            "planner spacetime holds at some times, with what stands and moves, and the plan.",
            (13.0, 8.6),
            reach_figure,
        ),
        RunFigure("motion.png", MOTION, (13.0, 6.8), motion_figure, compares=True),
        RunFigure(
            "outcomes.png",
            "Success with its 95 % Wilson interval, failures by name, and iterations.",
            (13.0, 4.4),
            outcomes_figure,
        ),
    )

    def other_planners(self, settings: InterceptSettings) -> dict[str, Any]:
        """The best that splits path and speed, or the default: each takes a minute to compile."""
        others = super().other_planners(settings)
        return {name: others[name] for name in COMPARED if name in others}

    def setting(self, cases: Any) -> dict[str, Any]:
        """Map, body and limits that all cases have in common, for the manifest."""
        bounds = first_values(cases, ["lower", "upper"])
        return bounds | first_values(cases.body, prefix="body_") | first_values(cases.limits)

    def plan_of_row(self, row: dict[str, Any], setting: dict[str, Any]) -> CarPlan:
        """The plan of a row, without the place of the meeting."""
        return car_plan(row)

    def tally(self, settings: InterceptSettings) -> InterceptTally:
        """An empty count of rows."""
        return InterceptTally()

    def findings(self, manifest: dict[str, Any]) -> list[str]:
        """When targets are met, how closely, and with how much acceleration."""
        summary = manifest["summary"]
        if summary["mean_miss"] is None:
            return []
        return [
            f"Targets are met after {summary['mean_meeting_time']:.2f} s, "
            f"{1e3 * summary['mean_miss']:.2g} mm off, with "
            f"{summary['mean_rms_acceleration']:.3f} m/s² rms acceleration; means of the successes."
        ]

    def remarks(self, manifest: dict[str, Any]) -> list[str]:
        """Where the numbers come from, a sentence each."""
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
