"""What a run has to know of its task; every task has a sweep, and changes of it what it wants."""

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

    name: str  # of the file
    caption: str
    size: tuple[float, float]  # width and height [inch]
    draw: Callable[[Figure, RunRows], None]  # takes an empty figure and a `report.RunRows`


class Sweep(Generic[AnySettings]):
    """The sweep of a task: sources, planning, judging, columns, table and figures.

    What stands here serves any task; a task's own class, named by `SweepSettings.RUN`, replaces
    what it has better.
    """

    frame: ClassVar[str] = ""  # axes and times of the columns, in words
    own_columns: ClassVar[Sequence[Column]] = ()
    single_columns: ClassVar[Sequence[Column]] = ()  # of one case that was asked for alone
    figures: ClassVar[tuple[RunFigure, ...]] = (
        RunFigure(
            "outcomes.png",
            "Success with its 95 % Wilson interval, failures by name, and iterations.",
            (13.0, 4.4),
            outcomes_figure,
        ),
    )
    counts: ClassVar[type[Tally]] = Tally  # of rows
    single_figures: ClassVar[Sequence[RunFigure]] = ()  # of one case that was asked for alone
    failure_words: ClassVar[Mapping[str, str]] = {  # heading -> column that is shown of a failure
        "case": "index",
        "solver's status": "status",
        "referee": "sentence",
    }

    def __init__(self, task: Task):
        self.task = task

    @property
    def kind(self) -> str:
        """Of a run, as its manifest has it."""
        return f"sweep {self.task.name}"

    def columns(self, batch: RefereedBatch) -> Sequence[Column]:
        """Return the columns of the run: the task's own, or every leaf of case, plan, verdict."""
        return self.own_columns or leaf_columns(batch)

    def planner(self, settings: AnySettings) -> Planner:
        """Return the planner of a run."""
        return self.task.planner(settings.planner, **settings.planner_options())

    def other_planners(self, settings: AnySettings) -> Entries:
        """Return the task's other planners of such cases by name, as far as they are installed."""
        own, _ = self.task.split_planner(settings.planner)
        made = {}
        for name in self.task.all_planners():
            if name != own and name not in self.task.from_file:
                with contextlib.suppress(MissingExtra):
                    made[name] = self.task.planner(name)
        kind = self.planner(settings).case_type
        return {name: one for name, one in made.items() if one.case_type is kind}

    def require_fit(self, settings: AnySettings, planner: Planner, cases: PyTree) -> None:
        """Raise `ArgumentError` unless the planner is one of such cases."""
        require(
            isinstance(cases, planner.case_type),
            "planner",
            f"one that takes the cases of suite {settings.suite}",
            settings.planner,
        )

    def open_source(self, settings: AnySettings, batch: int) -> Source:
        """Return the source of a sweep's cases; `batch` where the settings name none.

        Raises:
            ArgumentError: the settings ask for what is not there.
        """
        return DrawnSource(**fill_in(settings, settings.DEFAULT_NUM, batch), task=self.task)

    def plan(self, planner: Planner, cases: PyTree) -> PyTree:
        """Return the plans of a batch."""
        return plan(planner, cases)

    def judge(self, cases: PyTree, plans: PyTree, settings: AnySettings) -> PyTree:
        """Return the referee's verdict on plans."""
        return self.task.judge(cases, plans, **settings.judge_options())

    def setting(self, cases: PyTree) -> Entries:
        """Return physics and limits that all cases have in common, for the manifest."""
        return {}

    def plan_of_row(self, row: Row, setting: Entries) -> Plan | None:
        """Return the plan of a row; None where rows of the task are not read back."""
        return None

    def tally(self, settings: AnySettings) -> Tally:
        """Return an empty count of rows."""
        return self.counts()

    def title(self, manifest: Entries) -> str:
        """Return margins of table and page."""
        settings = manifest["parameters"]
        name = self.task.name.capitalize()
        return f"{name} sweep, suite {settings['suite']}, planner {settings['planner']}"

    def table(self, manifest: Entries) -> RateTable:
        """Return success rates."""
        summary, settings = manifest["summary"], manifest["parameters"]
        header = ["suite", "cases", f"{settings['planner']} %", "95 % interval"]
        cells = rate_cells(summary["successes"], summary["num"])
        return RateTable("Success", header, [[settings["suite"], *cells]])

    def findings(self, manifest: Entries) -> list[str]:
        """Return what else a run says of itself at the top, a sentence each."""
        return []

    def remarks(self, manifest: Entries) -> list[str]:
        """Return where the numbers come from, a sentence each."""
        settings = manifest["parameters"]
        return [
            f"Cases: {settings['num']:,} of suite {settings['suite']}, seed {settings['seed']}.",
            "A success is the referee's.",
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
    """Return leaves of the first case as plain numbers, to six digits to hide float32.

    Without `names` these are all fields of the tree. Those that are not there, and those that hold
    fields of their own, are left out.
    """
    names = names or [field.name for field in dataclasses.fields(tree)]
    known = {name: vars(tree)[name] for name in names}
    leaves = {
        prefix + name: np.asarray(value, float)[0]
        for name, value in known.items()
        if value is not None and not dataclasses.is_dataclass(value)
    }
    return {name: leaf.round(6).tolist() for name, leaf in leaves.items()}
