"""The sweep of a task: everything that a run needs from its task."""

import contextlib
import dataclasses
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Generic

import numpy as np
from jaxtyping import PyTree
from matplotlib.figure import Figure

from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError, MissingExtra, UnknownName
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Plan
from planner_jax.core.registry import Task, task_named
from planner_jax.planning.plan import plan
from planner_jax.runs.columns import Column, RefereedBatch, leaf_columns
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.run_folder import RunRows
from planner_jax.runs.settings import AnySettings, SweepSettings
from planner_jax.runs.source import DrawnSource, Source, fill_in
from planner_jax.runs.summary import Tally
from planner_jax.runs.table import RateTable, rate_cells
from planner_jax.sweep.figures import outcomes_figure


@dataclasses.dataclass(frozen=True)
class RunFigure:
    """One figure of a task's runs."""

    name: str  # file name
    caption: str
    size: tuple[float, float]  # width and height [inch]
    draw: Callable[[Figure, RunRows], None]  # draws into an empty figure


class Sweep(Generic[AnySettings]):
    """The sweep of a task: sources, planning, judging, columns, table and figures.

    This class serves any task. The class of a task, named by `SweepSettings.RUN`, overrides parts.
    """

    frame: ClassVar[str] = ""  # axes and time of the columns, as text
    own_columns: ClassVar[Sequence[Column]] = ()
    single_columns: ClassVar[Sequence[Column]] = ()  # used by the command `plan`
    figures: ClassVar[tuple[RunFigure, ...]] = (
        RunFigure("outcomes.png", "Number of plans by iterations.", (9.0, 4.4), outcomes_figure),
    )
    counts: ClassVar[type[Tally]] = Tally  # class of the counts
    single_figures: ClassVar[Sequence[RunFigure]] = ()  # used by the command `plan`
    # Returns the plan of a row, bit for bit, from the row and the setting of its run.
    plan_of_row: Callable[[Row, Entries], Plan] | None = None
    failure_words: ClassVar[Mapping[str, str]] = {  # heading -> column of the list of failures
        "case": "index",
        "solver's status": "status",
        "referee": "sentence",
    }

    def __init__(self, task: Task):
        self.task = task

    @property
    def kind(self) -> str:
        """Kind of the run in its manifest."""
        return f"sweep {self.task.name}"

    def columns(self, batch: RefereedBatch) -> Sequence[Column]:
        """Return the columns of the run: `own_columns`, or every leaf of case, plan and verdict."""
        return self.own_columns or leaf_columns(batch)

    def planner(self, settings: AnySettings) -> Planner:
        """Return the planner of a run."""
        return self.task.planner(settings.planner, **settings.planner_options())

    def other_planners(self, settings: AnySettings) -> Entries:
        """Return the task's other planners for such cases by name, if they are installed."""
        own, _ = self.task.split_planner(settings.planner)
        made = {}
        for name in self.task.all_planners():
            if name != own and name not in self.task.from_file:
                with contextlib.suppress(MissingExtra):
                    made[name] = self.task.planner(name)
        kind = self.planner(settings).case_type
        return {name: one for name, one in made.items() if one.case_type is kind}

    def require_fit(self, settings: AnySettings, planner: Planner, cases: PyTree) -> None:
        """Raise `ArgumentError` unless the planner takes such cases."""
        require(
            isinstance(cases, planner.case_type),
            "planner",
            f"one that takes the cases of suite {settings.suite}",
            settings.planner,
        )

    def open_source(self, settings: AnySettings, batch: int) -> Source:
        """Return the source of a sweep's cases; `batch` is the default of the settings."""
        return DrawnSource(**fill_in(settings, settings.DEFAULT_NUM, batch), task=self.task)

    def plan(self, planner: Planner, cases: PyTree) -> PyTree:
        """Return the plans of a batch."""
        return plan(planner, cases)

    def judge(self, cases: PyTree, plans: PyTree, settings: AnySettings) -> PyTree:
        """Return the referee's verdicts on plans."""
        return self.task.judge(cases, plans, **settings.judge_options())

    def setting(self, cases: PyTree) -> Entries:
        """Return physics and limits that all cases share, for the manifest."""
        return {}

    def tally(self, settings: AnySettings) -> Tally:
        """Return a tally without counts."""
        return self.counts()

    def title(self, manifest: Entries) -> str:
        """Return the title of table and page."""
        settings = manifest["parameters"]
        name = self.task.name.capitalize()
        return f"{name} sweep, suite {settings['suite']}, planner {settings['planner']}"

    def table(self, manifest: Entries) -> RateTable:
        """Return the table of success rates."""
        summary, settings = manifest["summary"], manifest["parameters"]
        header = ["suite", "cases", f"{settings['planner']} %", "95 % interval"]
        cells = rate_cells(summary["successes"], summary["num"])
        return RateTable("Success", header, [[settings["suite"], *cells]])

    def findings(self, manifest: Entries) -> list[str]:
        """Return sentences on findings of the task, for the headline."""
        return []

    def remarks(self, manifest: Entries) -> list[str]:
        """Return sentences on the origin of the numbers."""
        settings = manifest["parameters"]
        return [
            f"Cases: {settings['num']:,} of suite {settings['suite']}, seed {settings['seed']}.",
            "A plan is a success if the referee accepts it.",
        ]


def settings_of(task: Task) -> type[SweepSettings]:
    """Return the class of a task's sweep settings."""
    return pkgutil.resolve_name(task.sweep)


def sweep_of(task: Task) -> Sweep:
    """Return the sweep of a task."""
    name = settings_of(task).RUN
    return pkgutil.resolve_name(name)(task) if name else Sweep(task)


def sweep_of_run(manifest: Entries, name: str = "out") -> Sweep:
    """Return the sweep of a run; `name` is the argument that holds its path.

    Raises:
        ArgumentError: the run is of another kind, or of a task that is not installed.
    """
    first, _, task = str(manifest["kind"]).partition(" ")
    if first != "sweep":
        raise ArgumentError(name, "the folder of a sweep", shown=f"a {manifest['kind']}")
    try:
        return sweep_of(task_named(task))
    except UnknownName as error:
        raise ArgumentError(name, f"the folder of a known task: {error}", shown="") from None


def first_values(tree: PyTree, names: Sequence[str] = (), prefix: str = "") -> Entries:
    """Return leaves of the first case as plain numbers, rounded to six digits.

    Args:
        tree: batch of cases, or a part of it.
        names: fields; by default all. None and nested fields are left out.
        prefix: of the names in the result.
    """
    names = names or [field.name for field in dataclasses.fields(tree)]
    known = {name: vars(tree)[name] for name in names}
    leaves = {
        prefix + name: np.asarray(value, float)[0]
        for name, value in known.items()
        if value is not None and not dataclasses.is_dataclass(value)
    }
    return {name: leaf.round(6).tolist() for name, leaf in leaves.items()}
