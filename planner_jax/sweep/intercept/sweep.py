"""Runs over many cases of a car that meets a moving target among walls and moving obstacles."""

import dataclasses

import numpy as np
import pyarrow as pa
from jaxtyping import PyTree

from planner_jax.core.protocol import take
from planner_jax.referee.intercept import InterceptVerdict
from planner_jax.runs.manifest import Entries
from planner_jax.runs.summary import COUNTED, Tally
from planner_jax.sweep.figures import CAPTION as MOTION
from planner_jax.sweep.intercept.columns import COLUMNS, FRAME
from planner_jax.sweep.intercept.figures import motion_figure, plane_figure
from planner_jax.sweep.intercept.settings import GroupSettings, InterceptSettings
from planner_jax.sweep.rows import car_plan
from planner_jax.sweep.sweep import Picture, RunFigure, Sweep, first_values
from planner_jax.task.intercept import drawing
from planner_jax.task.intercept.drawing import SampledDrive, sample_drive

# Planners whose plans for one case of a run are drawn beside the plan of the run's own planner.
COMPARED = ("lattice", "spacetime")


class InterceptTally(Tally):
    """Counts of successes, and their means of meeting time, miss distance and RMS acceleration."""

    MEANS = ("meeting_time", "miss", "rms_acceleration")
    READS = (*COUNTED, *MEANS, "mover_clearance")
    NEAR = 0.1  # [m] the figures prefer a case whose car passes a moving obstacle at less than this

    def examples(self, rows: pa.Table, success: np.ndarray) -> list[np.ndarray]:
        """Return masks (B,) over B rows, by which the case in the report's figures is chosen.

        The first mask has successes whose car comes closer than 0.1 m to a moving obstacle.
        """
        is_near = rows["mover_clearance"].to_numpy() < self.NEAR
        return [success & is_near, *super().examples(rows, success)]


class InterceptSweep(Sweep[InterceptSettings]):
    """Sweeps that plan and judge many cases of a car that meets a moving target."""

    frame, own_columns, counts = FRAME, COLUMNS, InterceptTally
    plan_of_row = staticmethod(car_plan)
    figures = (
        RunFigure(
            "plane.png",
            "Cases of the run from above, with at most two failures. A colour stands for a time: "
            "body and path of the car, target and movers.",
            (13.0, 8.7),
            plane_figure,
        ),
        RunFigure("motion.png", MOTION, (13.0, 6.8), motion_figure),
        *Sweep.figures,
    )

    def other_planners(self, settings: InterceptSettings) -> Entries:
        """Return only the planners named in `COMPARED`, because the others take long to compile."""
        others = super().other_planners(settings)
        return {name: others[name] for name in COMPARED if name in others}

    def setting(self, cases: PyTree) -> Entries:
        """Return map, car body and limits that all cases share, for the manifest's `setting`."""
        bounds = first_values(cases, ["lower", "upper"])
        reverse = np.abs(np.asarray(cases.limits.least_speed))
        limits = dataclasses.replace(cases.limits, reverse_speed=reverse)
        return bounds | first_values(cases.body, prefix="body_") | first_values(limits)

    def findings(self, manifest: Entries) -> list[str]:
        """Return a sentence on mean meeting time, miss distance and acceleration of successes."""
        summary = manifest["summary"]
        if summary["mean_miss"] is None:
            return []
        return [
            f"Targets are met after {summary['mean_meeting_time']:.2f} s, "
            f"{1e3 * summary['mean_miss']:.2g} mm off, with "
            f"{summary['mean_rms_acceleration']:.3f} m/s² rms acceleration; means of the successes."
        ]

    def remarks(self, manifest: Entries) -> list[str]:
        """Return sentences for the report: cases, limits, and when a plan is a success."""
        limits = manifest["setting"]
        return [
            *super().remarks(manifest)[:-1],
            f"Limits: speed {limits['speed']:g} m/s, acceleration {limits['acceleration']:g} "
            f"m/s², lateral {limits['lateral_acceleration']:g} m/s², curvature "
            f"{limits['curvature']:g} 1/m, steering rate {limits['steering_rate']:g} rad/s; body "
            f"{limits['body_length']:g} x {limits['body_width']:g} m. Sizes and limits are of a "
            "model car of scale 1:10: an assumption.",
            "The referee accepts a success: every limit within 1e-3 relative, at all samples no "
            f"obstacle more than {2.5 * limits['body_length']:g} mm inside the body or its margin, "
            "and at the end the middle of the body within the case's tolerance of the target.",
        ]

    def pictures(self, case: PyTree, plan: PyTree, verdict: PyTree, planner: str) -> list[Picture]:
        """Return one picture: walls, moving obstacles, target and car from above."""
        drive = sample_drive(case, [plan], [case.target], verdict)
        return [_picture(drive, verdict)]


class GroupSweep(Sweep[GroupSettings]):
    """Sweeps that plan and judge many cases of a car that meets several targets in turn."""

    def other_planners(self, settings: GroupSettings) -> Entries:
        """Return the task's other planner, unless it would have to meet many targets."""
        return {} if settings.has_many else super().other_planners(settings)

    def pictures(self, case: PyTree, plan: PyTree, verdict: PyTree, planner: str) -> list[Picture]:
        """Return one picture from above, of the drives up to the first that the referee rejects."""
        num = int(verdict.leg) + 1
        legs = [take(plan.legs, k) for k in range(num)]
        targets = [take(case.shared.target, int(k)) for k in plan.order[:num]]
        return [_picture(sample_drive(case.shared, legs, targets, verdict), verdict)]


def _picture(drive: SampledDrive, verdict: InterceptVerdict) -> Picture:
    draw = lambda figure: drawing.draw_judged(drive, verdict, figure.subplots())  # noqa: E731
    return Picture("plane.png", drawing.figure_size(drive), draw)
