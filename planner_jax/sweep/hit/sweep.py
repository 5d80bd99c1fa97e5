"""Runs over many hits: quadrotors return serves in the 36 court scenarios of [Yu2023bat]."""

import dataclasses

import jax
import numpy as np
import pyarrow as pa
from jaxtyping import PyTree

from planner_jax.baselines.hit import comparison
from planner_jax.baselines.hit.comparison import ScenarioTally
from planner_jax.core.choices import require, require_one_of
from planner_jax.core.errors import ArgumentError, CaseError
from planner_jax.runs.manifest import Entries
from planner_jax.runs.source import Chunk, Source, fill_in
from planner_jax.runs.table import RateTable
from planner_jax.sweep.figures import CAPTION as MOTION
from planner_jax.sweep.hit.columns import COLUMNS, FRAME, SINGLE_COLUMNS
from planner_jax.sweep.hit.figures import court_figure, motion_figure, path_figure
from planner_jax.sweep.hit.settings import HitSettings
from planner_jax.sweep.quadrotor import recovery_remark
from planner_jax.sweep.quadrotor_settings import robot_remark
from planner_jax.sweep.rows import quadrotor_plan
from planner_jax.sweep.sweep import RunFigure, Sweep, first_values
from planner_jax.task.hit.court import check_cases
from planner_jax.task.hit.published import read_serves
from planner_jax.task.hit.spec import REAL_SCENARIOS, TASK
from planner_jax.task.hit.suites import Serves, generate_serves, to_cases


@dataclasses.dataclass(frozen=True)
class ServeSource(Source):
    """Source of the cases of a sweep of hits, which are made from drawn or published serves."""

    settings: HitSettings
    folder: Serves | None  # all serves of published files, if the settings name a folder of files

    def cases(self, first: int, last: int) -> Chunk:
        """Return cases `first` to `last - 1` with their serves; raise if a case is invalid."""
        settings = self.settings
        if self.folder is not None:
            serves = self.folder[first:last]
        else:
            scenarios = REAL_SCENARIOS.get(str(settings.suite))
            serves = generate_serves(last - first, settings.seed, scenarios, first=first)
        try:
            cases = to_cases(serves, seed=settings.seed, **settings.draw_options())
            check_cases(cases)
        except CaseError as error:
            raise ArgumentError("serves", f"sound cases: {error}", verb="make", shown="") from error
        return Chunk(serves.index, jax.tree.map(np.asarray, cases), serves)

    def check(self) -> PyTree:
        """Return the first `batch` cases; raise if one, or any serve of a file, is invalid."""
        cases = super().check()
        for chunk in range(1, 1 if self.folder is None else self.num_chunks):
            self.chunk(chunk)
        return cases

    def description(self) -> Entries:
        """Return the manifest entry on the serves: their source, number and SHA-256 digest."""
        if self.folder is None:
            return {"serves": {"source": "generated", "distinct": self.num, "sha256": None}}
        described = comparison.describe_serves(self.folder[: self.num])
        return {"serves": {"source": self.settings.serves, **described}}


class HitTally(ScenarioTally):
    """Counts of successes by court scenario: where a serve comes from, and where it goes."""

    def examples(self, rows: pa.Table, success: np.ndarray) -> list[np.ndarray]:
        """Return masks (B,) over B rows, by which the case in the report's figures is chosen.

        The first mask has successes with a serve from the left to a target in the far region.
        """
        scenario = rows["scenario"].to_numpy()
        left_to_far = success & np.array([name[0] + name[2] == "LF" for name in scenario])
        return [left_to_far, *super().examples(rows, success)]


class HitSweep(Sweep[HitSettings]):
    """Sweeps that plan and judge many cases of a quadrotor that returns a served ball."""

    frame, own_columns, counts = FRAME, COLUMNS, HitTally
    plan_of_row = staticmethod(quadrotor_plan)
    figures = (
        RunFigure(
            "court.png",
            "Serves, planned trajectories and returned balls, from above and from the side. "
            "Cases are evenly spaced in the run; failures are added up to twelve.",
            (9.0, 10.6),
            court_figure,
        ),
        RunFigure("motion.png", MOTION, (13.0, 6.8), motion_figure),
        *Sweep.figures,
    )
    single_columns = SINGLE_COLUMNS
    single_figures = (
        RunFigure("path.png", "Ball and quadrotor in space.", (11.0, 8.0), path_figure),
        figures[1],
    )
    failure_words = {"case": "index", "scenario": "scenario", **Sweep.failure_words}

    def open_source(self, settings: HitSettings, batch: int) -> ServeSource:
        """Return the source of a sweep's cases: drawn serves, or a folder of published serves."""
        # Suites that other packages add cannot be used, since they define cases without serves.
        require_one_of(TASK.suites, "suite", str(settings.suite))
        folder = None if settings.serves is None else read_serves(settings.serves)
        num = settings.DEFAULT_NUM if folder is None else len(folder)
        fits = folder is None or (settings.num or 0) <= num
        require(fits, "num", f"<= {num}, the serves that the folder holds", settings.num)
        return ServeSource(**fill_in(settings, num, batch), folder=folder)

    def setting(self, cases: PyTree) -> Entries:
        """Return physics and limits that all cases share, for the manifest's entry `setting`."""
        names = ("drag", "gravity", "restitution", "racket_height", "racket_radius")
        setting = first_values(cases, names)
        return setting | first_values(cases.limits) | first_values(cases.hit_limits)

    def table(self, manifest: Entries) -> RateTable:
        """Return success rates [%] of the 36 court scenarios, beside the rates in [Yu2023bat]."""
        return comparison.make_table(manifest)

    def remarks(self, manifest: Entries) -> list[str]:
        """Return sentences for the report: robot, serves, limits and rules of the referee."""
        summary, settings = manifest["summary"], manifest["parameters"]
        law = f"drawn from the published law, suite {settings['suite']}, seed {settings['seed']}"
        origin = "cases of published trial files" if settings["serves"] else law
        start = settings["start"]
        start = "uniform over the half court" if start == "uniform" else f"{tuple(start)} m"
        truth = "with" if settings["drag_after_impact"] else "without"
        return [
            *robot_remark(settings),
            *recovery_remark(settings),
            f"Serves: {summary['num']:,} {origin}; {manifest['serves']['distinct']:,} distinct "
            "balls (cases may share a ball and differ in the target).",
            f"Hover start {start}; planning starts {settings['delay']:g} s after the serve; speed, "
            f"acceleration and body-rate limits x {settings['limit_scale']:g}; returned ball "
            f"{truth} drag.",
            "The referee accepts a success: every limit within 1e-3 relative, landing within 1 cm.",
            comparison.explain_table(manifest),
        ]
