"""Base classes by which a run of simulated flights uses a task; `sims/tasks` implements them."""

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
    """A batch of B cases to fly, in NumPy arrays; subclasses add the balls or targets."""

    index: np.ndarray  # (B,), index in the run, from which the noise is drawn

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, rows: Any) -> Self:
        """Return the cases that a NumPy index selects; numbers that all cases share remain."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        pick = lambda leaf: leaf[rows] if np.ndim(leaf) else leaf  # noqa: E731
        return type(self)(**jax.tree.map(pick, fields))


@dataclasses.dataclass(frozen=True)
class Flights(abc.ABC):
    """The result of a batch of B simulated flights; arrays have the leading axis B."""

    first_plan: Any
    flown: Any  # the simulated flights; `tracking` (B, 2) [m] has rms and greatest error
    planning_seconds: float  # [s], wall time of plans that do not start from an earlier plan

    @property
    @abc.abstractmethod
    def success(self) -> np.ndarray:
        """Mask (B,) of the B flights that succeeded."""


@dataclasses.dataclass(frozen=True)
class FlightTask(abc.ABC):
    """The simulation of a task such as hits, with which `run.py` flies, scores and draws a run.

    The class of the settings names the subclass in its attribute `FLIGHT`. A task with balls
    inherits from `BallFlightTask`.
    """

    settings: Any  # settings of the task's class of `FlySettings`

    THING: ClassVar[str] = "ball"  # name of the target in pictures
    THING_RADIUS: ClassVar[float] = BALL_RADIUS  # [m], radius of the target in pictures
    CONTACT: ClassVar[str]  # participle for a met target in pictures, such as "caught"
    SUCCESS: ClassVar[str]  # predicate of a successful flight in sentences: "caught all balls"
    PUBLISHED: ClassVar[str]  # published result of the task, for the report's table
    # This task's own columns in the table of flights (one row per flight), beside common columns.
    COLUMNS: ClassVar[Sequence[Column]]
    # Lower and upper corner [m] of the region that pictures show; None to fit all drawn objects.
    BOUNDS: ClassVar[tuple[tuple[float, float, float], tuple[float, float, float]] | None] = None
    HAS_REACH: ClassVar[bool] = False  # whether the task implements `reachable`
    VIEW: ClassVar[tuple[float, float]] = (18.0, -68.0)  # elevation and azimuth of pictures [deg]
    # Position [m] of the browser viewer's camera, and the point [m] at which the camera is aimed.
    EYE: ClassVar[tuple[tuple[float, float, float], tuple[float, float, float]]] = (
        (1.5, -8.0, 3.0),
        (1.9, 0.0, 1.2),
    )

    @abc.abstractmethod
    def world(self) -> World:
        """Return the simulated world in which the flights take place."""

    @abc.abstractmethod
    def cases(self) -> Any:
        """Return all cases of the run, an instance of the task's `FlightCases`."""

    @abc.abstractmethod
    def fly(self, cases: Any, record: bool) -> Any:
        """Plan and simulate the flights of some cases, and return their results, a `Flights`.

        If `record` is true, the results include the states during the flights.
        """

    @abc.abstractmethod
    def recording(self, cases: Any, flights: Any, lanes: Sequence[int] | np.ndarray) -> Recording:
        """Return a recording of some flights of a batch, for pictures and films.

        Args:
            cases: the cases that were flown.
            flights: the result of `fly` for these cases.
            lanes: (F,) indices of the F flights in the batch.
        """

    @property
    @abc.abstractmethod
    def suite(self) -> str:
        """A short name of the cases, for the report of a run."""

    @property
    @abc.abstractmethod
    def conditions(self) -> str:
        """Noise and errors of the flights, as the beginning of a sentence of the report."""

    @property
    @abc.abstractmethod
    def simulated(self) -> str:
        """A description of the simulation, for the report of a run."""

    @abc.abstractmethod
    def parameters(self) -> dict[str, Any]:
        """Return all parameters of the simulation, as plain values for the run's manifest."""

    def every_column(self) -> Sequence[Column]:
        """Return the columns that this task adds to the common columns of the table of flights."""
        return self.COLUMNS

    def surroundings(self, index: int) -> Sequence[Prism]:
        """Return the standing and moving obstacles of the run's flight `index`, for drawing."""
        return ()

    def reachable(self, index: int) -> Sequence[tuple[float, np.ndarray]]:
        """Return times [s], each with points (P, 2) [m] where the robot could be at that time."""
        return ()

    def counts(self, rows: Any) -> dict[str, Any]:
        """Return the task's numbers for a run's summary, from the table with one row per flight."""
        return {}

    def findings(self, summary: Mapping[str, Any]) -> list[str]:
        """Return the task's sentences for the top of a run's report, from the run's summary."""
        return []

    def tables(self, rows: Any) -> Sequence[RateTable]:
        """Return the task's tables for a run's report, from the table with one row per flight."""
        return ()

    def draw(self, folder: Path, rows: Any) -> Sequence[str]:
        """Draw the task's figures for a run's report into a folder; return their file names."""
        return ()

    def title(self, recording: Recording, flight: int) -> str:
        """Return a picture's title: task, index of the flight in the run, and outcome."""
        outcome = "success" if recording.success[flight] else "failure"
        return f"{self.settings.TASK.name} {recording.index[flight]}, {outcome}"


_CONTACTS = leaves_of(
    "verdict.flown.contact",
    ("contact_time", "s", "of each ball's nearest passage", LIST, "time"),
    ("planned_time", "s", "planned time of that contact", LIST),
    ("offset", "m", "of the ball from the tool's centre", LIST),
    ("contact_ball_pos", "m", "balls x 3, flat", LIST, "ball_pos"),
    ("contact_robot_pos", "m", "balls x 3, flat", LIST, "robot_pos"),
    ("contact_tracking", "m", "of the robot from its plan then", LIST, "tracking"),
)


@dataclasses.dataclass(frozen=True)
class BallTask(FlightTask):
    """A task with flying balls, which a motion capture observes."""

    settings: BallFly

    @property
    def conditions(self) -> str:
        """Sensing noise and error of the balls' estimated drag, as the beginning of a sentence."""
        settings = self.settings
        words = (
            f"Noise {settings.noise}, {100 * settings.drag_error:g} % error of the estimated drag"
        )
        if settings.robot_sensing is not None:
            words += ", own state by a Kalman filter of IMU and captured poses"
        if settings.robot is None or settings.robot.drag is None:
            return words
        wind = " ".join(f"{speed:g}" for speed in settings.wind or (0.0, 0.0, 0.0))
        error = 100 * settings.rotor_drag_error
        return f"{words}, wind {wind} m/s, {error:g} % error of the rotors' drag in plans"

    @property
    def simulated(self) -> str:
        """A description of robot, motion capture and balls, for the report of a run."""
        exact = NOISES[self.settings.noise] == NOISES["none"]
        seen = "without errors or latency" if exact else "with noise, dropout and latency"
        robot = self.world().robot.WORDS
        return f"{robot}, motion capture {seen}, balls with quadratic drag"

    def parameters(self) -> dict[str, Any]:
        """Return the settings of the closed loop as plain values for the run's manifest."""
        return dataclasses.asdict(self.loop(record=False))

    def loop(self, record: bool) -> Loop:
        """Return the closed loop's settings; `record`: whether robot and ball states are stored."""
        settings = self.settings
        sensing = NOISES[settings.noise]
        return Loop(
            self.world(),
            sensing,
            replan=settings.rate,
            observer=settings.loop_observer,
            robot_filter=settings.robot_sensing,
            record=record,
        )


@dataclasses.dataclass(frozen=True)
class BallFlightTask(BallTask):
    """A task with flying balls, whose flights the closed loop `sims.loop` simulates."""

    @abc.abstractmethod
    def launches(self, cases: Any, flown: Flown) -> Launches:
        """Return each ball's state when its simulation starts, and just after the tool's impact."""

    def every_column(self) -> Sequence[Column]:
        """Return columns of the table of flights: ball contacts, then the task's own columns."""
        return [*_CONTACTS, *self.COLUMNS]

    def recording(self, cases: Any, flights: Any, lanes: Sequence[int] | np.ndarray) -> Recording:
        """Return a recording for pictures of the flights whose indices in the batch are `lanes`."""
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
