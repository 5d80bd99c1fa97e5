"""What the sweep has to know about hits."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from planner_jax.referee.hit import HitVerdict, referee_hits
from planner_jax.sweep.hit.columns import COLUMNS, FRAME
from planner_jax.sweep.hit.figures.court import court_figure
from planner_jax.sweep.hit.figures.motion import motion_figure
from planner_jax.sweep.hit.figures.rates import rates_figure
from planner_jax.sweep.hit.settings import HitSweep
from planner_jax.sweep.hit.source import ServeSource, open_source
from planner_jax.sweep.hit.summary import HitTally
from planner_jax.sweep.hit.table import rate_table, remarks
from planner_jax.sweep.table import RateTable
from planner_jax.sweep.task import RunFigure, SweepTask, first_values
from planner_jax.task.hit.plan import HitPlan
from planner_jax.task.hit.planners import PLANNERS, planner
from planner_jax.task.hit.scenario import HitScenario
from planner_jax.task.solve import plan


class HitTask(SweepTask):
    """Quadrotors that return served balls with a racket."""

    name = "hit"
    settings = HitSweep
    columns = COLUMNS
    frame = FRAME
    figures = (
        RunFigure(
            "court.png",
            "Serves, planned trajectories and returned balls, from above and from the side. "
            "Cases are taken evenly from the run, failures added where these hold fewer than "
            "twelve.",
            (9.0, 10.6),
            court_figure,
        ),
        RunFigure(
            "motion.png",
            "One plan along its time against the limits, beside the other planners' plans for "
            "the same serve.",
            (13.0, 6.8),
            motion_figure,
            compares=True,
        ),
        RunFigure(
            "rates.png",
            "Success per scenario with 95 % Wilson intervals, beside the published rates.",
            (13.0, 6.6),
            rates_figure,
        ),
    )
    failure_words = {
        "case": "index",
        "scenario": "scenario",
        "solver's status": "status",
        "referee": "sentence",
    }

    @property
    def planners(self) -> Sequence[str]:
        """Names of all planners."""
        return tuple(PLANNERS)

    def planner(self, name: str, options: dict[str, Any]) -> Any:
        """The planner of a name."""
        return planner(name, **options)

    def open_source(self, settings: HitSweep, batch: int) -> ServeSource:
        """The source of a sweep's serves."""
        return open_source(settings, batch)

    def plan(
        self, planner: Any, scenarios: HitScenario, settings: HitSweep
    ) -> tuple[HitScenario, HitPlan]:
        """The scenarios as they are, and plans."""
        return scenarios, plan(planner, scenarios)

    def judge(self, scenarios: HitScenario, plans: HitPlan, settings: HitSweep) -> HitVerdict:
        """The referee's verdict on plans."""
        return referee_hits(scenarios, plans, drag_after_impact=settings.drag_after_impact)

    def setting(self, scenarios: HitScenario) -> dict[str, Any]:
        """Physics and limits that all scenarios have in common, for the manifest."""
        physics = ["drag", "gravity", "restitution", "racket_height"]
        setting = first_values(scenarios, physics)
        for group in (scenarios.limits, scenarios.hit_limits):
            setting |= first_values(group, [field.name for field in dataclasses.fields(group)])
        return setting

    def tally(self, settings: HitSweep) -> HitTally:
        """An empty count of rows."""
        return HitTally()

    def title(self, manifest: dict[str, Any]) -> str:
        """Of table and page."""
        return f"Hit sweep, planner {manifest['parameters']['planner']}"

    def table(self, manifest: dict[str, Any]) -> RateTable:
        """Success per scenario beside the published rates."""
        return rate_table(manifest)

    def remarks(self, manifest: dict[str, Any]) -> list[str]:
        """Where the numbers come from, a sentence each."""
        return remarks(manifest)
