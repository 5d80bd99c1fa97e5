"""What a sweep has to know about its task, and nothing else of it."""

import abc
import dataclasses
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from matplotlib.figure import Figure

from planner_jax.sweep.columns import Column
from planner_jax.sweep.settings import SettingError, SweepSettings
from planner_jax.sweep.source import Source
from planner_jax.sweep.summary import Tally
from planner_jax.sweep.table import RateTable

# Name -> its description, as "module:attribute", so that a list of names imports none.
TASKS = {
    "hit": "planner_jax.sweep.hit.task:HitTask",
    "catch": "planner_jax.sweep.catch.task:CatchTask",
}


@dataclasses.dataclass(frozen=True)
class RunFigure:
    """One figure of a task's runs."""

    name: str  # of the file
    caption: str
    size: tuple[float, float]  # width and height [inch]
    draw: Callable[[Figure, Any], None]  # takes an empty figure and a `report.RunRows`
    compares: bool = False  # shows plans of the other planners too


class SweepTask(abc.ABC):
    """A task's part of its sweep: sources, planning, judging, columns, table and figures."""

    name: ClassVar[str]
    settings: ClassVar[type[SweepSettings]]
    columns: ClassVar[Sequence[Column]]  # of `plans.parquet`
    frame: ClassVar[str]  # axes and times of the columns, in words
    figures: ClassVar[Sequence[RunFigure]]
    failure_words: ClassVar[Mapping[str, str]]  # heading -> column that is shown of a failure

    @property
    def kind(self) -> str:
        """Of a run, as its manifest has it."""
        return f"sweep {self.name}"

    @property
    @abc.abstractmethod
    def planners(self) -> Sequence[str]:
        """Names of all planners."""

    @abc.abstractmethod
    def planner(self, name: str, options: dict[str, Any]) -> Any:
        """The planner of a name."""

    @abc.abstractmethod
    def open_source(self, settings: Any, batch: int) -> Source:
        """The source of a sweep's cases; `batch` where the settings name none.

        Raises:
            SettingError: the settings ask for what is not there.
        """

    @abc.abstractmethod
    def plan(self, planner: Any, scenarios: Any, settings: Any) -> tuple[Any, Any]:
        """Scenarios as they were planned, with what was decided about them, and plans."""

    @abc.abstractmethod
    def judge(self, scenarios: Any, plans: Any, settings: Any) -> Any:
        """The referee's verdict on plans."""

    @abc.abstractmethod
    def setting(self, scenarios: Any) -> dict[str, Any]:
        """Physics and limits that all scenarios have in common, for the manifest."""

    @abc.abstractmethod
    def tally(self, settings: Any) -> Tally:
        """An empty count of rows."""

    @abc.abstractmethod
    def title(self, manifest: dict[str, Any]) -> str:
        """Of table and page."""

    @abc.abstractmethod
    def table(self, manifest: dict[str, Any]) -> RateTable:
        """Success beside the published rates."""

    def findings(self, manifest: dict[str, Any]) -> list[str]:
        """What else a run says of itself at the top, a sentence each."""
        return []

    @abc.abstractmethod
    def remarks(self, manifest: dict[str, Any]) -> list[str]:
        """Where the numbers come from, a sentence each."""


def task_named(name: str) -> SweepTask:
    """The task of a name, a key of `TASKS`."""
    return pkgutil.resolve_name(TASKS[name])()


def task_of(manifest: dict[str, Any], name: str = "out") -> SweepTask:
    """The task of a run.

    Args:
        manifest: of the run.
        name: of the caller's argument that holds the run's path, for the message.

    Raises:
        SettingError: the run is of another kind.
    """
    first, _, task = str(manifest["kind"]).partition(" ")
    if first != "sweep" or task not in TASKS:
        raise SettingError(f"{name} must be the folder of a sweep, got a {manifest['kind']}")
    return task_named(task)


def first_values(tree: Any, names: Sequence[str], prefix: str = "") -> dict[str, Any]:
    """Leaves of the first case as plain numbers, to six digits so that float32 does not show."""
    leaves = {prefix + name: np.asarray(getattr(tree, name), float)[0] for name in names}
    return {name: leaf.round(6).tolist() for name, leaf in leaves.items()}
