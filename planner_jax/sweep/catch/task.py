"""What the sweep has to know about catches."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from planner_jax.referee.catch import CatchVerdict, referee_catches
from planner_jax.sweep.catch.columns import COLUMNS, FRAME
from planner_jax.sweep.catch.figures.flight import flight_figure
from planner_jax.sweep.catch.figures.motion import motion_figure
from planner_jax.sweep.catch.figures.outcomes import outcomes_figure
from planner_jax.sweep.catch.settings import CatchSweep
from planner_jax.sweep.catch.source import SuiteSource, open_source
from planner_jax.sweep.catch.summary import CatchTally
from planner_jax.sweep.catch.table import findings, rate_table, remarks
from planner_jax.sweep.table import RateTable
from planner_jax.sweep.task import RunFigure, SweepTask, first_values
from planner_jax.task.catch.decide import plan_catches
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.catch.planners import PLANNERS, catch_planner
from planner_jax.task.catch.scenario import CatchScenario


class CatchTask(SweepTask):
    """Quadrotors that catch flying targets with a net."""

    name = "catch"
    settings = CatchSweep
    columns = COLUMNS
    frame = FRAME
    figures = (
        RunFigure(
            "flight.png",
            "One plan from the side and from above, and its catches close up from the "
            "side: targets, quadrotor, and the net at every catch.",
            (13.0, 7.6),
            flight_figure,
        ),
        RunFigure(
            "motion.png",
            "The same plan along its time against the limits, beside the other planners' plans "
            "for the same case.",
            (13.0, 6.8),
            motion_figure,
            compares=True,
        ),
        RunFigure(
            "outcomes.png",
            "Success with its 95 % Wilson interval beside the published rates, failures by "
            "name, and the times of the catches that hold.",
            (13.0, 4.4),
            outcomes_figure,
        ),
    )
    failure_words = {"case": "index", "solver's status": "status", "referee": "sentence"}

    @property
    def planners(self) -> Sequence[str]:
        """Names of all planners."""
        return tuple(PLANNERS)

    def planner(self, name: str, options: dict[str, Any]) -> Any:
        """The planner of a name."""
        return catch_planner(name, **options)

    def open_source(self, settings: CatchSweep, batch: int) -> SuiteSource:
        """The source of a sweep's scenarios."""
        return open_source(settings, batch)

    def plan(
        self, planner: Any, scenarios: CatchScenario, settings: CatchSweep
    ) -> tuple[CatchScenario, CatchPlan]:
        """The scenarios with order and times as decided, and plans."""
        return plan_catches(planner, scenarios, settings.decide)

    def judge(self, scenarios: CatchScenario, plans: CatchPlan, settings: CatchSweep):
        """The referee's verdict on plans."""
        verdict: CatchVerdict = referee_catches(scenarios, plans, **settings.judgement())
        return verdict

    def setting(self, scenarios: CatchScenario) -> dict[str, Any]:
        """Physics and limits that all scenarios have in common, for the manifest."""
        limits = [field.name for field in dataclasses.fields(scenarios.limits)]
        return {
            **first_values(scenarios, ["gravity"]),
            **first_values(scenarios.net, ["height", "radius", "max_angle"], "net_"),
            **first_values(scenarios.limits, limits),
        }

    def tally(self, settings: CatchSweep) -> CatchTally:
        """An empty count of rows."""
        return CatchTally(decides=settings.planner != "mpp")

    def title(self, manifest: dict[str, Any]) -> str:
        """Of table and page."""
        settings = manifest["parameters"]
        return f"Catch sweep, suite {settings['suite']}, planner {settings['planner']}"

    def table(self, manifest: dict[str, Any]) -> RateTable:
        """Success beside the published rates."""
        return rate_table(manifest)

    def findings(self, manifest: dict[str, Any]) -> list[str]:
        """What was caught, when, and how close the decision was."""
        return findings(manifest)

    def remarks(self, manifest: dict[str, Any]) -> list[str]:
        """Where the numbers come from, a sentence each."""
        return remarks(manifest)
