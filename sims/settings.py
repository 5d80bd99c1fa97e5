"""Settings of a run of flights, one class per task; their fields become command-line options.

This module imports neither JAX nor MuJoCo; the method `FlySettings.flight` imports both.
"""

import dataclasses
import math
import pkgutil
from typing import Any, ClassVar

from planner_jax.core.choices import require, require_one_of, require_seed
from planner_jax.core.registry import Task, split_name
from planner_jax.core.room import require_memory
from planner_jax.core.tasks import all_tasks
from planner_jax.runs.settings import option, require_count
from planner_jax.sims.noise import (
    NOISES,
    PLANE_NOISES,
    PlaneSensing,
    RobotSensing,
    Sensing,
    require_whole,
)
from planner_jax.sweep.block.settings import require_moderate
from planner_jax.sweep.quadrotor_settings import WIND, resolve_robot, robot_option
from planner_jax.task.catch.spec import DECISIONS, TRAINED
from planner_jax.task.catch.spec import TASK as CATCH
from planner_jax.task.hit.spec import TASK as HIT
from planner_jax.task.intercept.spec import TASK as INTERCEPT
from planner_jax.task.rally.spec import TASK as RALLY
from planner_jax.task.team.spec import TASK as TEAM

_REPLAN = "replanning rate, 0 for never (default: {} with {}, 0 with other planners)"
# Cases of flights contain no order and times of catches, which the decision "given" would use.
_FLOWN_DECISIONS = {name: where for name, where in DECISIONS.items() if name != "given"}
_AT_ONCE = 4096  # greatest default number of flights per batch
# Estimated memory [bytes] of a flight during its simulation, and of its results afterwards.
_FLIGHT_BYTES, _FLOWN_BYTES = 1_000_000, 4_000
_FASTEST = 10_000.0  # [Hz], greatest replanning rate
# Greatest number of balls of a flight, chosen because compile time grows with every ball.
_MOST_BALLS = 12
LATEST_PLAN = 1.0  # [s], greatest time from a serve to its first plan
INTERVAL = 0.8  # [s], time between two throws [Yu2023catch, Fig. 1]


def fly_settings(task: str) -> type["FlySettings"]:
    """Return the class of settings for a task's flights.

    Args:
        task: name of the task in the registry; its entry names the class in the field `flight`.

    Raises:
        ArgumentError: there is no task of that name, or the task has no flights.
    """
    flown = {name: found.flight for name, found in all_tasks().items() if found.flight}
    require(task in flown, "task", f"one that can be flown ({', '.join(flown)})", task)
    return pkgutil.resolve_name(flown[task])


def require_interval(sensing: Sensing, replan: float) -> None:
    """Raise `ValueError` unless the 0.8 s between two throws are a multiple of the planning period.

    The planning period is the time from one plan to the next.

    Args:
        sensing: settings of the observations.
        replan: [Hz], rate of replanning; 0 for never.
    """
    period = sensing.observations_per_plan(replan) / sensing.rate
    rule = f"such that its period divides {INTERVAL:g} s"
    require_whole(INTERVAL / period, "replan", rule, replan)


@dataclasses.dataclass(frozen=True)
class FlySettings:
    """The settings that the flights of all tasks share; a task's subclass adds more.

    Raises:
        ArgumentError: a value is out of its range; the message is one line that begins with the
            setting's name.
    """

    num: int = option(64, "N", "number of flights")
    seed: int = option(0, "K", "random seed of cases and noise")
    batch: int | None = option(None, "B", "flights per batch (default: all, at most 4096)")
    planner: str = option("exact", "NAME", "planner of plans from scratch")
    replan: float | None = option(None, "HZ", _REPLAN.format("the task's own rate", "the first"))

    TASK: ClassVar[Task]  # the task; only the first of its planners can replan
    FLIGHT: ClassVar[str]  # the task's subclass of `FlightTask`, as "module:Class"
    RATE: ClassVar[float]  # [Hz], default rate of replanning

    def __post_init__(self) -> None:
        for name in ("num", "batch"):
            require_count(name, getattr(self, name), 1, none=name == "batch")
        require_seed(self.seed)
        self.require_memory()
        self.TASK.split_planner(self.planner)
        require(not self.rate > _FASTEST, "replan", f"<= {_FASTEST:g}", self.rate)
        again = self.rate > 0.0
        require(not again or self._is_first, "replan", "0 for other planners", self.rate)
        self.check_rate()

    def require_memory(self) -> None:
        """Raise `ArgumentError` unless a batch and the results of all flights fit into memory."""
        if self.batch is None:
            require_memory("num", min(self.num, _AT_ONCE), _FLIGHT_BYTES)
        else:
            require_memory("batch", self.batch, _FLIGHT_BYTES)
        require_memory("num", self.num, _FLOWN_BYTES)

    @property
    def rate(self) -> float:
        """The rate of replanning [Hz]; by default `RATE` for the first planner, else 0."""
        if self.replan is not None:
            return self.replan
        return self.RATE if self._is_first else 0.0

    @property
    def _is_first(self) -> bool:
        return self.planner == next(iter(self.TASK.planners))

    def check_rate(self) -> None:
        """Raise `ValueError` if the rate of replanning [Hz] is negative; subclasses check more."""
        require(self.rate >= 0.0, "replan", ">= 0", self.rate)

    def flight(self) -> Any:
        """Return the task's `sims.task.FlightTask` with these settings."""
        return pkgutil.resolve_name(self.FLIGHT)(self)


@dataclasses.dataclass(frozen=True)
class BallFly(FlySettings):
    """The settings that flights of all tasks with balls share."""

    noise: str = option("lab", "NAME", f"preset of sensing noise: {', '.join(NOISES)}")
    drag_error: float = option(
        0.15, "F", "relative error of the initial estimate of the balls' drag, of random sign"
    )
    robot: Any = robot_option("the task's")
    wind: tuple[float, ...] | None = WIND
    rotor_drag_error: float = option(
        0.0, "F", "relative error of the robot's drag in plans; -1: plans know no drag"
    )

    TOOL: ClassVar[str] = "net"  # tool that the robot must carry, or "racket"

    @property
    def loop_observer(self) -> str:
        """The observer of the balls, a key of `noise.OBSERVERS`."""
        return "energy"

    @property
    def robot_sensing(self) -> RobotSensing | None:
        """The sensors of the filter of the robot's own state; None for errors `robot_stds`."""
        return None

    def known_robot(self) -> Any:
        """Return the robot as plans know it, with an error of its drag; None for the default."""
        if not self.rotor_drag_error:
            return self.robot
        factor, drag = 1.0 + self.rotor_drag_error, self.robot.drag
        known = dataclasses.replace(drag, across=factor * drag.across, along=factor * drag.along)
        return dataclasses.replace(self.robot, drag=known)

    def air(self) -> dict[str, Any]:
        """Return the true drag and wind as arguments of the simulated robot."""
        drag = None if self.robot is None else self.robot.drag
        return {"drag": drag} | ({} if self.wind is None else {"wind": tuple(self.wind)})

    def __post_init__(self) -> None:
        require_one_of(NOISES, "noise", self.noise)
        super().__post_init__()
        require(0.0 <= self.drag_error < 1.0, "drag_error", ">= 0 and < 1", self.drag_error)
        object.__setattr__(self, "robot", resolve_robot(self.robot, self.TOOL, self.wind))
        error, has_drag = self.rotor_drag_error, bool(self.robot and self.robot.drag)
        require(-1.0 <= error < math.inf, "rotor_drag_error", "finite and >= -1", error)
        rule = "0 unless the file of the robot states its drag"
        require(has_drag or error == 0.0, "rotor_drag_error", rule, error)

    def check_rate(self) -> None:
        """Raise `ValueError` unless plans are made a whole number of observations apart."""
        NOISES[self.noise].observations_per_plan(self.rate)


@dataclasses.dataclass(frozen=True)
class ThrownFly(BallFly):
    """The settings that flights of hits and catches share."""

    observer: str = option(
        "default", "NAME", "estimator of the balls: default, or published, as in the papers"
    )

    robot_filter: bool = option(
        False, "", "a Kalman filter of IMU and captured poses estimates the robot's own state"
    )

    PUBLISHED: ClassVar[str]  # key of `noise.OBSERVERS`: the published observer

    def __post_init__(self) -> None:
        require_one_of(("default", "published"), "observer", self.observer)
        super().__post_init__()

    @property
    def loop_observer(self) -> str:
        """The observer of the balls, a key of `noise.OBSERVERS`."""
        return super().loop_observer if self.observer == "default" else self.PUBLISHED

    @property
    def robot_sensing(self) -> RobotSensing | None:
        """The sensors of the filter of the robot's own state; None for errors `robot_stds`."""
        return RobotSensing() if self.robot_filter else None


@dataclasses.dataclass(frozen=True)
class CatchFly(ThrownFly):
    """Settings of flights of a quadrotor that catches thrown balls."""

    replan: float | None = option(None, "HZ", _REPLAN.format(100, "exact"))
    planner: str = option("exact", "NAME", "planner of plans from scratch")
    balls: int = option(
        1, "N", f"number of balls per flight, thrown {INTERVAL:g} s apart, at most {_MOST_BALLS}"
    )
    decide: str = option(
        "greedy",
        "NAME",
        "method that decides the order and initial times of catches: "
        f"{', '.join(_FLOWN_DECISIONS)}, policy:FILE",
    )
    redecide: float | None = option(
        None,
        "HZ",
        "rate at which order and times are decided again, 0 for never (default: same as --replan)",
    )

    TASK: ClassVar[Task] = CATCH
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.catch:CatchFlight"
    PUBLISHED: ClassVar[str] = "linear"
    TOOL: ClassVar[str] = "net"
    RATE: ClassVar[float] = 100.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_count("balls", self.balls, 1)
        require(self.balls <= _MOST_BALLS, "balls", f"<= {_MOST_BALLS}", self.balls)
        split_name(_FLOWN_DECISIONS, "decide", self.decide, TRAINED)

    @property
    def redecide_rate(self) -> float:
        """The rate [Hz] at which order and times of catches are chosen anew; by default `rate`."""
        return self.rate if self.redecide is None else self.redecide

    def flight(self) -> Any:
        """Return the task's `sims.task.FlightTask` with these settings.

        Raises:
            ArgumentError: the file of the policy `decide` cannot be read.
        """
        from planner_jax.task.decisions import find_decision

        find_decision(DECISIONS, self.decide, TRAINED)
        return super().flight()

    def check_rate(self) -> None:
        """Raise `ValueError` unless throws, and new orders of catches, coincide with replanning.

        The closed loop can add balls and change the order of catches only when it plans anew.
        """
        super().check_rate()
        if self.balls > 1:
            require_interval(NOISES[self.noise], self.rate)
        if self.redecide:
            rule = f"0 or a divisor of the {self.rate:g} Hz of replanning"
            require(0.0 < self.redecide <= self.rate, "redecide", rule, self.redecide)
            require_whole(self.rate / self.redecide, "redecide", rule, self.redecide)


@dataclasses.dataclass(frozen=True)
class HitFly(ThrownFly):
    """Settings of flights of a quadrotor that hits served balls."""

    replan: float | None = option(None, "HZ", _REPLAN.format(50, "exact"))
    planner: str = option("exact", "NAME", "planner of plans from scratch")
    suite: str = option("S.1", "NAME", "suite of serves")
    seen: float = option(0.25, "S", "time for which a ball is observed before its first plan")

    TASK: ClassVar[Task] = HIT
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.hit:HitFlight"
    PUBLISHED: ClassVar[str] = "rls"
    TOOL: ClassVar[str] = "racket"
    RATE: ClassVar[float] = 50.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(HIT.suites, "suite", self.suite)
        require(0.0 < self.seen <= LATEST_PLAN, "seen", f"> 0 and <= {LATEST_PLAN:g}", self.seen)


@dataclasses.dataclass(frozen=True)
class RallyFly(BallFly):
    """Settings of trials in which a quadrotor hits one ball again and again."""

    num: int = option(16, "N", "number of trials")
    replan: float | None = option(None, "HZ", _REPLAN.format(25, "exact"))
    planner: str = option("exact", "NAME", "planner of plans from scratch")
    suite: str = option("juggle", "NAME", "suite of rallies")
    hits: int | None = option(
        None, "N", "number of hits after which a trial ends (default: the suite's own)"
    )
    restitution_error: float = option(
        0.1, "F", "relative error of the initial estimate of the restitution, of random sign"
    )
    state: str | None = option(
        None, "FILE", "file for the state of the trials, from which the same command continues"
    )

    TASK: ClassVar[Task] = RALLY
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.rally:RallyFlight"
    TOOL: ClassVar[str] = "racket"
    RATE: ClassVar[float] = 25.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(RALLY.suites, "suite", self.suite)
        require_count("hits", self.hits, 1, none=True)
        error = self.restitution_error
        require(0.0 <= error < 1.0, "restitution_error", ">= 0 and < 1", error)
        require(self.rate > 0.0, "replan", "> 0, as rallies must be planned again", self.rate)
        is_one = self.batch is None or self.batch >= self.num
        require(self.state is None or is_one, "batch", "left out with a file of states", self.batch)


@dataclasses.dataclass(frozen=True)
class TeamFly(FlySettings):
    """Settings of flights in which several quadrotors catch balls that they share."""

    num: int = option(16, "N", "number of flights")
    replan: float | None = option(None, "HZ", "replanning rate: 0, as teams plan once")
    suite: str = option("team2-swarm12", "NAME", "suite of teams")
    noise: str = option("lab", "NAME", f"preset of sensing noise: {', '.join(NOISES)}")

    TASK: ClassVar[Task] = TEAM
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.team:TeamFlight"
    RATE: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        require_one_of(NOISES, "noise", self.noise)
        require_one_of(TEAM.suites, "suite", self.suite)
        super().__post_init__()

    def check_rate(self) -> None:
        """Raise `ValueError` unless the rate is 0, because teams are planned once."""
        require(self.rate == 0.0, "replan", "0, as teams plan once", self.rate)


@dataclasses.dataclass(frozen=True)
class InterceptFly(FlySettings):
    """Settings of drives of a car that intercepts a moving target among obstacles."""

    replan: float | None = option(None, "HZ", _REPLAN.format(1, "spacetime"))
    planner: str = option("spacetime", "NAME", "planner of plans from scratch")
    suite: str = option("easy", "NAME", "suite of interceptions")
    noise: str = option("paper", "NAME", f"preset of sensing noise: {', '.join(PLANE_NOISES)}")
    latency: float = option(0.05, "S", "latency of observations and measured poses")
    observation_rate: float = option(
        1.0, "HZ", "rate of observations of the target during the drive"
    )
    known_target: bool = option(
        False, "", "the target's path is known, not predicted from observations"
    )
    predict_movers: bool = option(
        False, "", "paths of moving obstacles are predicted from observations, not known"
    )
    slip: bool = option(False, "", "simulate tyres that slip")

    TASK: ClassVar[Task] = INTERCEPT
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.intercept_flights:InterceptFlight"
    RATE: ClassVar[float] = 1.0

    def __post_init__(self) -> None:
        require_one_of(PLANE_NOISES, "noise", self.noise)
        require_one_of(INTERCEPT.all_suites(), "suite", self.suite)
        require_moderate("latency", self.latency)
        require_moderate("observation_rate", self.observation_rate, _FASTEST)
        super().__post_init__()

    @property
    def sensing(self) -> PlaneSensing:
        """The noise, latency and rate of the sensing of car and target.

        Raises:
            ValueError: a value is out of its range.
        """
        preset = PLANE_NOISES[self.noise]
        return dataclasses.replace(
            preset, latency=self.latency, observation_rate=self.observation_rate
        )

    def check_rate(self) -> None:
        """Raise `ValueError` unless the time between plans is a multiple of 20 ms, one frame."""
        self.sensing.frames_per_plan(self.rate)
