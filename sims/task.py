"""What a run of flights asks of a task; the classes in `tasks` answer."""

import abc
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import jax
import numpy as np

from planner_jax.runs.columns import LIST, Column, leaves_of
from planner_jax.runs.table import RateTable
from planner_jax.sims.loop_state import Flown, Loop
from planner_jax.sims.model import BALL_RADIUS, World
from planner_jax.sims.noise import NOISES
from planner_jax.sims.recording import Launches, Recording, make_recording
from planner_jax.sims.scenery import Prism
from planner_jax.sims.settings import BallFly


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
    flown: Any  # what was simulated; `tracking` (B, 2) [m], root mean square and worst, and more
    planning_seconds: float  # of the host's clock, spent on plans from scratch

    @property
    @abc.abstractmethod
    def success(self) -> np.ndarray:
        """Which flights succeeded, (B,) bool."""


@dataclasses.dataclass(frozen=True)
class FlightTask(abc.ABC):
    """A task as a run of flights knows it, with the settings of the run.

    Its class is named by the settings' `FLIGHT`; `run.py` knows nothing else of a task. One that
    meets balls inherits from `BallFlightTask`.
    """

    settings: Any  # of the task's class of `FlySettings`

    THING: ClassVar[str] = "ball"  # what is to be met, in pictures
    THING_RADIUS: ClassVar[float] = BALL_RADIUS  # [m]
    CONTACT: ClassVar[str]  # what a thing is that was met, in pictures: "caught"
    SUCCESS: ClassVar[str]  # what a flight has done that succeeded: "caught all balls"
    PUBLISHED: ClassVar[str]  # what is published of the task, for the table
    COLUMNS: ClassVar[Sequence[Column]]  # of the rows, besides those of all tasks
    # Corners of what pictures show [m]; None for all that moves and stands.
    BOUNDS: ClassVar[tuple[tuple[float, float, float], tuple[float, float, float]] | None] = None
    HAS_REACH: ClassVar[bool] = False  # whether `reachable` can say anything
    VIEW: ClassVar[tuple[float, float]] = (18.0, -68.0)  # elevation and azimuth of pictures [deg]
    # Where the eye of the viewer is, and where it looks [m].
    EYE: ClassVar[tuple[tuple[float, float, float], tuple[float, float, float]]] = (
        (1.5, -8.0, 3.0),
        (1.9, 0.0, 1.2),
    )

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
    def recording(self, cases: Any, flights: Any, lanes: Sequence[int] | np.ndarray) -> Recording:
        """The recording of some of the flights that were recorded.

        Args:
            cases: that were flown.
            flights: what came of them.
            lanes: (F,) which of them.
        """

    @property
    @abc.abstractmethod
    def suite(self) -> str:
        """What was flown, in a word or two for title and table."""

    @property
    @abc.abstractmethod
    def conditions(self) -> str:
        """Under what noise and errors was flown, as the begin of a sentence."""

    @property
    @abc.abstractmethod
    def simulated(self) -> str:
        """What is simulated, for the page of a run."""

    @abc.abstractmethod
    def parameters(self) -> dict[str, Any]:
        """Everything that shapes the simulation, as plain values for the manifest."""

    def every_column(self) -> Sequence[Column]:
        """The task's columns."""
        return self.COLUMNS

    def surroundings(self, index: int) -> Sequence[Prism]:
        """What else stands or moves in one flight of the run, to be looked at."""
        return ()

    def reachable(self, index: int) -> Sequence[tuple[float, np.ndarray]]:
        """Where the robot of a flight could be and when: times [s] and points (P, 2) [m]."""
        return ()

    def counts(self, rows: Any) -> dict[str, Any]:
        """What else is said in numbers of the rows of a run, for the summary."""
        return {}

    def findings(self, summary: Mapping[str, Any]) -> list[str]:
        """What else is said of a run at its top, a sentence each."""
        return []

    def tables(self, rows: Any) -> Sequence[RateTable]:
        """What else is told of the rows of a run, in tables under that of the rates."""
        return ()

    def draw(self, folder: Path, rows: Any) -> Sequence[str]:
        """Write more figures of the rows of a run into a folder; the names of their files."""
        return ()

    def title(self, recording: Recording, flight: int) -> str:
        """Task, place in the run and outcome of a flight."""
        outcome = "success" if recording.success[flight] else "failure"
        return f"{self.settings.TASK.name} {recording.index[flight]}, {outcome}"


_CONTACTS = leaves_of(
    "verdict.flown.contact",
    ("contact_time", "s", "of each ball's nearest passage", LIST, "time"),
    ("planned_time", "s", "of that contact", LIST),
    ("offset", "m", "ball from the tool's centre", LIST),
    ("contact_ball_pos", "m", "a point a ball", LIST, "ball_pos"),
    ("contact_robot_pos", "m", "a point a ball", LIST, "robot_pos"),
    ("contact_tracking", "m", "robot from its plan then", LIST, "tracking"),
)


@dataclasses.dataclass(frozen=True)
class BallFlightTask(FlightTask):
    """A task that meets balls, flown in `sims.loop`."""

    settings: BallFly

    @abc.abstractmethod
    def launches(self, cases: Any, flown: Flown) -> Launches:
        """What is known of the balls of some flights before and after these were simulated."""

    def every_column(self) -> Sequence[Column]:
        """The contacts, and the task's columns."""
        return [*_CONTACTS, *self.COLUMNS]

    @property
    def conditions(self) -> str:
        """Noise and wrong drag."""
        settings = self.settings
        return f"Noise {settings.noise}, drag believed {100 * settings.drag_error:g} % wrong"

    @property
    def simulated(self) -> str:
        """Robot, motion capture and balls."""
        exact = NOISES[self.settings.noise] == NOISES["none"]
        seen = "without errors or latency" if exact else "with noise, dropout and latency"
        robot = self.world().robot.WORDS
        return f"{robot}, motion capture {seen}, balls with quadratic drag"

    def parameters(self) -> dict[str, Any]:
        """Those of the closed loop."""
        return dataclasses.asdict(self.loop(record=False))

    def loop(self, record: bool) -> Loop:
        """The closed loop of the flights, with a record of every look or without."""
        settings = self.settings
        sensing = NOISES[settings.noise]
        return Loop(self.world(), sensing, replan=settings.rate, record=record)

    def recording(self, cases: Any, flights: Any, lanes: Sequence[int] | np.ndarray) -> Recording:
        """The recording of some of the flights that were recorded; see `FlightTask`."""
        pick = lambda leaf: np.asarray(leaf)[lanes]  # noqa: E731
        flown = dataclasses.replace(
            flights.flown,
            contact=jax.tree.map(pick, flights.flown.contact),
            record=jax.tree.map(pick, flights.flown.record),
        )
        some = cases[lanes]
        return make_recording(
            self.world(),
            flown,
            self.launches(some, flown),
            index=some.index,
            success=pick(flights.success),
        )
