"""What a run of flights is asked to do, a class a task; the command line is made from its fields.

Nothing here imports JAX or MuJoCo; `FlySettings.flight` does.
"""

import dataclasses
import math
import pkgutil
from typing import Any, ClassVar

from planner_jax.core.choices import SCALES, require, require_memory, require_one_of, require_seed
from planner_jax.core.registry import Task, all_tasks, split_name
from planner_jax.runs.settings import option, require_count
from planner_jax.sims.noise import NOISES, PLANE_NOISES, PlaneSensing, Sensing, require_whole
from planner_jax.sims.robots.arm.drives import ENCODERS, TORQUES, Drives
from planner_jax.sweep.block.settings import REGIMES, require_frame_rate, require_moderate
from planner_jax.sweep.quadrotor_settings import resolve_robot, robot_option
from planner_jax.task.block.spec import TASK as BLOCK
from planner_jax.task.catch.spec import DECISIONS, TRAINED
from planner_jax.task.catch.spec import TASK as CATCH
from planner_jax.task.hit.spec import TASK as HIT
from planner_jax.task.intercept.spec import TASK as INTERCEPT

_REPLAN = "plans a second, 0 for the first only (default: {} with {}, 0 with other planners)"
# Flights have no order or times of their own to be given.
_FLOWN_DECISIONS = {name: where for name, where in DECISIONS.items() if name != "given"}
_AT_ONCE = 4096  # flights, by default
# As estimated, bytes of a flight that is simulated with others, and of the rows that it leaves.
_FLIGHT_BYTES, _FLOWN_BYTES = 1_000_000, 4_000
_FASTEST = 10_000.0  # [Hz]
_MOST_BALLS = 12  # of one flight, as of the largest suite: every one makes the program longer
INTERVAL = 0.8  # [s], from throw to throw [Yu2023catch, Fig. 1]


def fly_settings(task: str) -> type["FlySettings"]:
    """The settings of a task's flights.

    Args:
        task: its name in the registry, which knows the settings as the task's `flight`.

    Raises:
        ArgumentError: there is no task of that name, or it has no flights.
    """
    flown = {name: found.flight for name, found in all_tasks().items() if found.flight}
    require(task in flown, "task", f"one that can be flown ({', '.join(flown)})", task)
    return pkgutil.resolve_name(flown[task])


def require_interval(sensing: Sensing, replan: float) -> None:
    """Raise `ValueError` unless the interval of throws is a whole number of planning periods.

    Args:
        sensing: whose looks divide such a period.
        replan: [Hz], of planning anew; 0 for never.
    """
    period = sensing.looks_per_plan(replan) / sensing.rate
    rule = f"such that its period divides {INTERVAL:g} s"
    require_whole(INTERVAL / period, "replan", rule, replan)


@dataclasses.dataclass(frozen=True)
class FlySettings:
    """The settings that the flights of all tasks have; a task's own class adds its own.

    Raises:
        ArgumentError: a value breaks its rule; one line that begins with its name.
    """

    num: int = option(64, "N", "flights")
    seed: int = option(0, "K", "of what is drawn and of noise")
    batch: int | None = option(None, "B", "flights at once (default: all up to 4096)")
    planner: str = option("exact", "NAME", "that makes the plans from scratch")
    replan: float | None = option(None, "HZ", _REPLAN.format("the task's own rate", "the first"))

    TASK: ClassVar[Task]  # with its name and planners; the first one is also planned anew
    FLIGHT: ClassVar[str]  # the `FlightTask` that flies it, as "module:Class"
    RATE: ClassVar[float]  # [Hz], of planning anew by default

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
        """Raise `ArgumentError` unless flights that are simulated at once fit into memory."""
        if self.batch is None:
            require_memory("num", min(self.num, _AT_ONCE), _FLIGHT_BYTES)
        else:
            require_memory("batch", self.batch, _FLIGHT_BYTES)
        require_memory("num", self.num, _FLOWN_BYTES)

    @property
    def rate(self) -> float:
        """[Hz] of planning anew; only the task's first planner is planned anew."""
        if self.replan is not None:
            return self.replan
        return self.RATE if self._is_first else 0.0

    @property
    def _is_first(self) -> bool:
        return self.planner == next(iter(self.TASK.planners))

    def check_rate(self) -> None:
        """Raise `ValueError` unless plans can be made anew at `rate`."""
        require(self.rate >= 0.0, "replan", ">= 0", self.rate)

    def flight(self) -> Any:
        """The task's `sims.task.FlightTask` with these settings."""
        return pkgutil.resolve_name(self.FLIGHT)(self)


@dataclasses.dataclass(frozen=True)
class BallFly(FlySettings):
    """The settings that flights among balls have besides."""

    noise: str = option("lab", "NAME", f"of sensing: {', '.join(NOISES)}")
    drag_error: float = option(
        0.15, "F", "relative, of what is believed of the balls' drag, either way"
    )

    def __post_init__(self) -> None:
        require_one_of(NOISES, "noise", self.noise)
        super().__post_init__()
        require(0.0 <= self.drag_error < 1.0, "drag_error", ">= 0 and < 1", self.drag_error)

    def check_rate(self) -> None:
        """Raise `ValueError` unless a period of planning is a whole number of looks."""
        NOISES[self.noise].looks_per_plan(self.rate)


@dataclasses.dataclass(frozen=True)
class CatchFly(BallFly):
    """Flights that catch thrown balls."""

    replan: float | None = option(None, "HZ", _REPLAN.format(100, "exact"))
    planner: str = option("exact", "NAME", "of plans from scratch")
    balls: int = option(1, "N", f"thrown {INTERVAL:g} s apart, {_MOST_BALLS} at most")
    decide: str = option(
        "greedy", "NAME", f"order and first times: {', '.join(_FLOWN_DECISIONS)}, policy:FILE"
    )
    redecide: float | None = option(
        None,
        "HZ",
        "rate at which order and times are decided anew, 0 for never (default: that of --replan)",
    )

    robot: Any = robot_option("paper-catcher")

    TASK: ClassVar[Task] = CATCH
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.catch:CatchFlight"
    RATE: ClassVar[float] = 100.0

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "robot", resolve_robot(self.robot, "net"))
        require_count("balls", self.balls, 1)
        require(self.balls <= _MOST_BALLS, "balls", f"<= {_MOST_BALLS}", self.balls)
        split_name(_FLOWN_DECISIONS, "decide", self.decide, TRAINED)

    @property
    def redecide_rate(self) -> float:
        """[Hz] of deciding anew."""
        return self.rate if self.redecide is None else self.redecide

    def flight(self) -> Any:
        """As for every task.

        Raises:
            ArgumentError: the policy's file cannot be read.
        """
        from planner_jax.task.arguments import find_decision

        find_decision(DECISIONS, self.decide, TRAINED)
        return super().flight()

    def check_rate(self) -> None:
        """Raise `ValueError` unless a plan also begins whenever a ball comes into sight."""
        super().check_rate()
        if self.balls > 1:
            require_interval(NOISES[self.noise], self.rate)
        if self.redecide:
            rule = f"0 or a divisor of the {self.rate:g} Hz at which plans are made anew"
            require(0.0 < self.redecide <= self.rate, "redecide", rule, self.redecide)
            require_whole(self.rate / self.redecide, "redecide", rule, self.redecide)


@dataclasses.dataclass(frozen=True)
class HitFly(BallFly):
    """Flights that hit served balls."""

    replan: float | None = option(None, "HZ", _REPLAN.format(50, "exact"))
    planner: str = option("exact", "NAME", "of plans from scratch")
    suite: str = option("S.1", "NAME", "of serves")

    robot: Any = robot_option("paper-hitter")

    TASK: ClassVar[Task] = HIT
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.hit:HitFlight"
    RATE: ClassVar[float] = 50.0

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "robot", resolve_robot(self.robot, "racket"))
        require_one_of(HIT.suites, "suite", self.suite)


@dataclasses.dataclass(frozen=True)
class InterceptFly(FlySettings):
    """Drives of a car that meets a moving target among obstacles."""

    replan: float | None = option(None, "HZ", _REPLAN.format(1, "spacetime"))
    planner: str = option("spacetime", "NAME", "of plans from scratch")
    suite: str = option("easy", "NAME", "of interceptions")
    noise: str = option("paper", "NAME", f"of what is seen: {', '.join(PLANE_NOISES)}")
    latency: float = option(0.05, "S", "age of what is seen [s]")
    observation_rate: float = option(1.0, "HZ", "observations of the target during the drive")
    known_target: bool = option(
        False, "", "the target's path is known, not predicted from observations"
    )
    predict_movers: bool = option(False, "", "movers are predicted from observations, too")
    slip: bool = option(False, "", "tyres that slip")

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
        """How car and target are seen.

        Raises:
            ValueError: a value is out of its range.
        """
        preset = PLANE_NOISES[self.noise]
        return dataclasses.replace(
            preset, latency=self.latency, observation_rate=self.observation_rate
        )

    def check_rate(self) -> None:
        """Raise `ValueError` unless a period of planning is a whole number of frames."""
        self.sensing.frames_per_plan(self.rate)


@dataclasses.dataclass(frozen=True)
class BlockFly(FlySettings):
    """Blocks of an arm with a shield."""

    replan: float | None = option(
        None, "HZ", "with --perception: rate at which the motion is decided anew (default: 0, once)"
    )
    planner: str = option("online", "NAME", "of all plans, made one at a time")
    suite: str = option("pole", "NAME", "of throws")
    regime: str = option("R2", "NAME", f"limits that plans keep: {', '.join(REGIMES)}")
    wide: bool = option(
        False, "", "the ball may be 0.1 m off the shield's middle and 30 degrees off straight on"
    )
    perception: bool = option(
        False, "", "plan with what a camera has seen of the ball, which flies on as it does"
    )
    observe: float | None = option(
        None, "S", "until the ball's flight is known (default: 0.133, with --perception 0.25)"
    )
    planning_budget: float | None = option(
        None,
        "S",
        "for planning, after which the arm starts (default: 0.03, with --perception 0.05)",
    )
    noise: float = option(
        0.02,
        "M",
        "with --perception: standard deviation of each coordinate; 0 for a stereo camera's",
    )
    frame_rate: float = option(60.0, "HZ", "with --perception: of the camera")
    torque: float = option(1.0, "F", "share of the drives' torques that is there")
    lag: float = option(0.005, "S", "of the torques, first order")
    latency: float = option(0.0, "S", "by which plans come late to the joints")
    encoders: str = option("fine", "NAME", f"noise of angles and rates: {', '.join(ENCODERS)}")
    mass_error: float = option(0.05, "F", "relative, of the masses that control believes")

    TASK: ClassVar[Task] = BLOCK
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.block:BlockFlight"
    RATE: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        require_one_of(ENCODERS, "encoders", self.encoders)
        require_one_of(REGIMES, "regime", self.regime)
        require_one_of(BLOCK.suites, "suite", self.suite)
        for name in ("observe", "planning_budget", "noise", "lag", "latency"):
            require_moderate(name, getattr(self, name))
        require(abs(self.mass_error) < 1.0, "mass_error", "> -1 and < 1", self.mass_error)
        require_frame_rate(self.frame_rate)
        own = self.planner.partition(":")[0] != "library"
        require(
            own or not self.perception, "planner", "one that plans for the very ball", self.planner
        )
        require(0.0 < self.torque < math.inf, "torque", "finite and > 0", self.torque)
        least, most = SCALES
        rule = f"from {least:g} to {most:g}"
        require(least <= self.torque <= most, "torque", rule, self.torque)
        super().__post_init__()

    @property
    def until_known(self) -> float:
        """[s], from when the ball is first seen until its flight is known, or first fitted."""
        # [Natarajan2024, Section VI-B]: 82.9 ms for perception and 50 ms for the rest of the
        # system.
        usual = 0.25 if self.perception else 0.133
        return usual if self.observe is None else self.observe

    @property
    def until_set(self) -> float:
        """[s], from then on until the arm sets out."""
        usual = 0.05 if self.perception else 0.03
        return usual if self.planning_budget is None else self.planning_budget

    @property
    def drives(self) -> Drives:
        """What drives and encoders can do.

        Raises:
            ValueError: a value is out of its range.
        """
        angle_std, rate_std = ENCODERS[self.encoders]
        return Drives(
            torques=tuple(self.torque * each for each in TORQUES),
            lag=self.lag,
            latency=self.latency,
            angle_std=angle_std,
            rate_std=rate_std,
            mass_error=self.mass_error,
        )

    def flight(self) -> Any:
        """As for every task.

        Raises:
            ArgumentError: the planner's file is no library, or one of another scene or limits.
        """
        if BLOCK.split_planner(self.planner)[1]:
            from planner_jax.task.block import draw

            planner = BLOCK.make_planner(self.planner, {})
            planner.check(draw(1, self.suite, regime=self.regime))  # type: ignore[attr-defined]
        return super().flight()

    def check_rate(self) -> None:
        """Raise `ValueError` unless plans can be made anew, and the drives are possible."""
        rule = ">= 0, and 0 without perception: a block is planned once"
        most = math.inf if self.perception else 1e-9
        require(0.0 <= self.rate < most, "replan", rule, self.rate)
        _ = self.drives
