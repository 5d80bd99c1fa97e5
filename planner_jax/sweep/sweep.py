"""The class `Sweep`: what a run over many cases needs from its task, such as columns, figures."""

import contextlib
import dataclasses
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Generic

import jax
import numpy as np
from jaxtyping import PyTree
from matplotlib.figure import Figure

from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError, UnknownName
from planner_jax.core.missing_extra import MissingExtra
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Plan
from planner_jax.core.registry import Task
from planner_jax.core.tasks import task_named
from planner_jax.planning.plan import plan
from planner_jax.runs.columns import Column, RefereedBatch, leaf_columns, rows_of
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.run_folder import RunFolder, RunRows
from planner_jax.runs.settings import AnySettings, SweepSettings
from planner_jax.runs.source import Chunk, DrawnSource, Source, fill_in
from planner_jax.runs.summary import Tally
from planner_jax.runs.table import RateTable, rate_cells
from planner_jax.sweep.figures import outcomes_figure


@dataclasses.dataclass(frozen=True)
class Picture:
    """One picture of one plan."""

    name: str  # file name
    size: tuple[float, float]  # width and height [inch]
    draw: Callable[[Figure], object]  # function that draws into an empty figure


@dataclasses.dataclass(frozen=True)
class RunFigure:
    """One figure in the reports of a task's sweeps."""

    name: str  # file name in the folder `figures`
    caption: str
    size: tuple[float, float]  # width and height [inch]
    draw: Callable[[Figure, RunRows], None]  # function that draws a run into an empty figure

    def picture(self, run: RunRows) -> Picture:
        """Return the picture that the figure of one run is."""
        return Picture(self.name, self.size, lambda figure: self.draw(figure, run))


@dataclasses.dataclass(frozen=True)
class _OneRow(RunRows):
    """One planned case in the form of a finished run of many cases, to draw the same figures."""

    row: Row

    def same_case(self) -> list[tuple[str, Row]]:
        """Return the name of the planner and the planned case, as a list with one pair."""
        return [(self.manifest["parameters"]["planner"], self.row)]


class Sweep(Generic[AnySettings]):
    """Base class for a task's runs over many cases: it makes, plans, judges and reports them."""

    frame: ClassVar[str] = ""  # text on the coordinate frame and time origin of the columns
    # Columns of the rows; () stands for a column for each array of cases, plans and verdicts.
    own_columns: ClassVar[Sequence[Column]] = ()
    single_columns: ClassVar[Sequence[Column]] = ()  # columns that `single_figures` read
    figures: ClassVar[tuple[RunFigure, ...]] = (
        RunFigure("outcomes.png", "Number of plans by iterations.", (9.0, 4.4), outcomes_figure),
    )
    counts: ClassVar[type[Tally]] = Tally  # class that counts the rows for the summary
    single_figures: ClassVar[Sequence[RunFigure]] = ()  # figures of one case, the clearest first
    # A function that restores a plan from a row. Its arguments are the row and the manifest's entry
    # `setting`, which holds the physics of all cases.
    plan_of_row: Callable[[Row, Entries], Plan] | None = None
    # Heading -> name of the shown column of the rows, for the report's list of failed cases.
    failure_words: ClassVar[Mapping[str, str]] = {
        "case": "index",
        "solver's status": "status",
        "referee": "sentence",
    }

    def __init__(self, task: Task):
        self.task = task

    @property
    def kind(self) -> str:
        """Entry `kind` of the manifest, such as "sweep hit"."""
        return f"sweep {self.task.name}"

    def columns(self, batch: RefereedBatch) -> Sequence[Column]:
        """Return the columns of the rows; by default one for each array of case, plan, verdict."""
        return self.own_columns or leaf_columns(batch)

    def planner(self, settings: AnySettings) -> Planner:
        """Create the planner that the settings of a run name, with its options in the settings."""
        return self.task.planner(settings.planner, **settings.planner_options())

    def other_planners(self, settings: AnySettings) -> Entries:
        """Return the task's other installed planners that take the same class of cases, by name."""
        own, _ = self.task.split_planner(settings.planner)
        made = {}
        for name in self.task.all_planners():
            if name != own and name not in self.task.from_file:
                with contextlib.suppress(MissingExtra):
                    made[name] = self.task.planner(name)
        kind = self.planner(settings).case_type
        return {name: one for name, one in made.items() if one.case_type is kind}

    def require_fit(self, settings: AnySettings, planner: Planner, cases: PyTree) -> None:
        """Raise `ArgumentError` if the planner takes another class of cases."""
        rule = f"one that takes the cases of suite {settings.suite}"
        require(isinstance(cases, planner.case_type), "planner", rule, settings.planner)

    def open_source(self, settings: AnySettings, batch: int) -> Source:
        """Return the source of a sweep's cases; `batch` is the default batch size."""
        return DrawnSource(**fill_in(settings, settings.DEFAULT_NUM, batch), task=self.task)

    def plan(self, planner: Planner, cases: PyTree) -> PyTree:
        """Return the planner's plans for a batch of cases."""
        return plan(planner, cases)

    def judge(self, cases: PyTree, plans: PyTree, settings: AnySettings) -> PyTree:
        """Return the referee's verdicts on a batch of plans."""
        return self.task.judge(cases, plans, **settings.judge_options())

    def setting(self, cases: PyTree) -> Entries:
        """Return physics and limits that all cases share, for the entry `setting` of manifests."""
        return {}

    def pictures(self, case: PyTree, plan: PyTree, verdict: PyTree, planner: str) -> list[Picture]:
        """Return pictures of one case and its plan, the clearest first.

        Args:
            case: one case.
            plan: its plan, solved or not.
            verdict: the referee's verdict on the plan.
            planner: name of the planner in legends.
        """
        case, plan = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (case, plan))
        fields = {name: np.asarray(value)[None] for name, value in vars(verdict).items()}
        verdict = dataclasses.replace(verdict, **fields)
        batch = RefereedBatch(Chunk(np.zeros(1, int), case), plan, verdict)
        (row,) = rows_of(self.single_columns, batch, self.frame).to_pylist()
        manifest = {"parameters": {"planner": planner}, "setting": self.setting(case)}
        run = _OneRow(RunFolder(Path()), manifest, [], row)
        return [each.picture(run) for each in self.single_figures]

    def tally(self, settings: AnySettings) -> Tally:
        """Return a new counter of rows, from which the summary of a run is made."""
        return self.counts()

    def title(self, manifest: Entries) -> str:
        """Return the title of the report's table and HTML page."""
        settings = manifest["parameters"]
        name = self.task.name.capitalize()
        return f"{name} sweep, suite {settings['suite']}, planner {settings['planner']}"

    def table(self, manifest: Entries) -> RateTable:
        """Return the report's table of success rates, by default with one row for all cases."""
        summary, settings = manifest["summary"], manifest["parameters"]
        header = ["suite", "cases", f"{settings['planner']} %", "95 % interval"]
        cells = rate_cells(summary["successes"], summary["num"])
        return RateTable("Success", header, [[settings["suite"], *cells]])

    def findings(self, manifest: Entries) -> list[str]:
        """Return sentences on results that only this task has, for the head of the report."""
        return []

    def remarks(self, manifest: Entries) -> list[str]:
        """Return sentences for the end of the report: which cases, and what counts as success."""
        settings = manifest["parameters"]
        return [
            f"Cases: {settings['num']:,} of suite {settings['suite']}, seed {settings['seed']}.",
            "A plan is a success if the referee accepts it.",
        ]


def settings_of(task: Task) -> type[SweepSettings]:
    """Return the class of a task's sweep settings."""
    return pkgutil.resolve_name(task.sweep)


def sweep_of(task: Task) -> Sweep:
    """Return the sweep object of a task, of the class that its settings name in `RUN`."""
    name = settings_of(task).RUN
    return pkgutil.resolve_name(name)(task) if name else Sweep(task)


def sweep_of_run(manifest: Entries, name: str = "out") -> Sweep:
    """Return the sweep object of a run's task; if unknown, raise an error about option `name`."""
    first, _, task = str(manifest["kind"]).partition(" ")
    require(first == "sweep", name, "the folder of a sweep", shown=f"a {manifest['kind']}")
    try:
        return sweep_of(task_named(task))
    except UnknownName as error:
        raise ArgumentError(name, f"the folder of a known task: {error}", shown="") from None


def first_values(tree: PyTree, names: Sequence[str] = (), prefix: str = "") -> Entries:
    """Return fields of the first case of a batch as plain numbers, rounded to six decimals.

    `names` are names of fields of `tree`, by default all. In the result each name has the `prefix`.
    Fields that are None or dataclasses are left out, except for the fields of `air`.
    """
    found = {}
    for name in names or [field.name for field in dataclasses.fields(tree)]:
        value = vars(tree)[name]
        if value is not None and not dataclasses.is_dataclass(value):
            found[prefix + name] = np.asarray(value, float)[0].round(6).tolist()
        elif name == "air" and value is not None:
            found |= first_values(value, prefix="air_")
    return found
