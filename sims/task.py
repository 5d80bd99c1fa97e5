"""What a run of flights asks of a task; `tasks/catch.py` and `tasks/hit.py` answer."""

import abc
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import jax
import numpy as np

from planner_jax.sims.loop import Flown, Loop
from planner_jax.sims.model import World
from planner_jax.sims.noise import NOISES
from planner_jax.sims.recording import Launches, Recording, recorded
from planner_jax.sweep.columns import Column


@dataclasses.dataclass(frozen=True)
class FlightCases:
    """B cases to be flown, NumPy leaves; a task's own class adds what is thrown."""

    index: np.ndarray  # (B,) place in the whole, which decides the noise

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, rows: Any) -> Self:
        """Some of them, picked as NumPy does."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return type(self)(**jax.tree.map(lambda leaf: leaf[rows], fields))


@dataclasses.dataclass(frozen=True)
class Flights(abc.ABC):
    """What came of a batch of flights; leaves with a leading axis B."""

    first_plan: Any
    flown: Flown  # times from the first plan
    planning_seconds: float  # of the host's clock, spent on plans from scratch

    @property
    @abc.abstractmethod
    def success(self) -> np.ndarray:
        """Which flights succeeded, (B,) bool."""


@dataclasses.dataclass(frozen=True)
class FlightTask(abc.ABC):
    """A task as a run of flights knows it, with the settings of the run.

    Its class is named by the settings' `FLIGHT`; `run.py` knows nothing else of a task.
    """

    settings: Any  # of the task's class of `FlySettings`

    CONTACT: ClassVar[str]  # what a ball is that was met, in pictures: "caught"
    SUCCESS: ClassVar[str]  # what a flight has done that succeeded: "caught all balls"
    PUBLISHED: ClassVar[str]  # what is published of the task, for the table
    COLUMNS: ClassVar[Sequence[Column]]  # of `plans.parquet`, besides those of all tasks

    @abc.abstractmethod
    def world(self) -> World:
        """The simulated world."""

    @abc.abstractmethod
    def cases(self) -> Any:
        """All cases of the run, `FlightCases`."""

    @abc.abstractmethod
    def fly(self, cases: Any, record: bool) -> Any:
        """Plan and fly some cases, with a record of every look or without; `Flights`."""

    @abc.abstractmethod
    def launches(self, cases: Any, flown: Flown) -> Launches:
        """What is known of the balls of some flights before and after these were simulated."""

    @property
    @abc.abstractmethod
    def suite(self) -> str:
        """What was flown, in a word or two for title and table."""

    def counts(self, rows: Any) -> dict[str, int]:
        """What else is counted over the rows of a run, for the summary."""
        return {}

    def findings(self, summary: Mapping[str, Any]) -> list[str]:
        """What else is said of a run at its top, a sentence each."""
        return []

    def loop(self, record: bool) -> Loop:
        """The closed loop of the flights, with a record of every look or without."""
        settings = self.settings
        sensing = NOISES[settings.noise]
        return Loop(self.world(), sensing, replan=settings.rate, record=record)

    def recording(self, cases: Any, flights: Any, lanes: Sequence[int] | np.ndarray) -> Recording:
        """The recording of some of the flights that were recorded.

        Args:
            cases: that were flown.
            flights: what came of them.
            lanes: (F,) which of them.
        """
        pick = lambda leaf: np.asarray(leaf)[lanes]  # noqa: E731
        flown = dataclasses.replace(
            flights.flown,
            contact=jax.tree.map(pick, flights.flown.contact),
            record=jax.tree.map(pick, flights.flown.record),
        )
        some = cases[lanes]
        return recorded(
            self.world(),
            flown,
            self.launches(some, flown),
            index=some.index,
            success=pick(flights.success),
        )

    def title(self, recording: Recording, flight: int) -> str:
        """Task, place in the run and outcome of a flight."""
        outcome = "success" if recording.success[flight] else "failure"
        return f"{self.settings.TASK.name} {recording.index[flight]}, {outcome}"
