"""What a run of flights is asked to do, a class a task; the command line is made from its fields.

Nothing here imports JAX or MuJoCo; `FlySettings.flight` does.
"""

import dataclasses
import pkgutil
from collections.abc import Mapping
from typing import Any, ClassVar

from planner_jax.sims.noise import NOISES, Sensing, require_whole
from planner_jax.sweep.settings import SettingError, require, require_one_of
from planner_jax.task.catch.planners import PLANNERS as CATCH_PLANNERS
from planner_jax.task.hit.planners import PLANNERS as HIT_PLANNERS

FLIGHTS = {  # the tasks that can be flown -> their settings, as "module:Class"
    "catch": "planner_jax.sims.settings:CatchFly",
    "hit": "planner_jax.sims.settings:HitFly",
}

_REPLAN = "plans a second, 0 for the first only (default: {} with exact, 0 with other planners)"
INTERVAL = 0.8  # [s], from throw to throw (paper 000, Fig. 1)

# Serve, landing and target region of the simulated court (`court.SCENARIOS`) for the six real
# scenarios of paper 002, Section VI-C, which it names in words alone: an assumption.
HIT_SUITES: Mapping[str, tuple[str, ...]] = {
    "S.1": ("FNN", "FFN"),  # from different distances
    "S.2": ("FFF", "LFF"),  # serves from different directions
    "S.3": ("FFN", "FLN"),  # hit from different directions
    "S.4": ("FFL", "FNL"),  # hit straight, shoot sideways
    "S.5": ("FLL", "LLL"),  # hit and shoot sideways to the same side
    "S.6": ("FLR", "LLR"),  # hit and shoot sideways to different sides
}


def fly_settings(task: str) -> type["FlySettings"]:
    """The settings of a task's flights.

    Raises:
        SettingError: there is no task of that name.
    """
    require_one_of(FLIGHTS, "task", task)
    return pkgutil.resolve_name(FLIGHTS[task])


def require_interval(sensing: Sensing, replan: float) -> None:
    """Raise `ValueError` unless the interval of throws is a whole number of planning periods.

    Args:
        sensing: whose looks divide such a period.
        replan: [Hz], of planning anew; 0 for never.
    """
    period = sensing.looks_per_plan(replan) / sensing.rate
    rule = f"such that its period divides {INTERVAL:g} s"
    require_whole(INTERVAL / period, "replan", rule, replan)


def option(default: Any, metavar: str, words: str) -> Any:
    """A field of settings with what the command line says of it."""
    return dataclasses.field(default=default, metadata={"metavar": metavar, "help": words})


@dataclasses.dataclass(frozen=True)
class FlySettings:
    """The settings that the flights of all tasks have; a task's own class adds its own.

    Raises:
        SettingError: a value breaks its rule; one line that begins with its name.
    """

    num: int = option(64, "N", "flights")
    noise: str = option("lab", "NAME", f"of sensing: {', '.join(NOISES)}")
    replan: float | None = option(None, "HZ", _REPLAN.format("the task's own rate"))
    seed: int = option(0, "K", "of balls and noise")
    batch: int | None = option(None, "B", "flights at once (default: all up to 4096)")
    planner: str = option("exact", "NAME", "that makes the plans from scratch")
    drag_error: float = option(
        0.15, "F", "relative, of what is believed of the balls' drag, either way"
    )

    TASK: ClassVar[str]  # its name on the command line
    WORDS: ClassVar[str]  # what is flown, for the help
    FLIGHT: ClassVar[str]  # the `FlightTask` that flies it, as "module:Class"
    PLANNERS: ClassVar[Mapping[str, str]]  # of the task, by name
    RATE: ClassVar[float]  # [Hz], of planning anew by default

    def __post_init__(self) -> None:
        for name, least in (("num", 1), ("batch", 1), ("seed", 0)):
            value = getattr(self, name)
            require(value is None or value >= least, name, f">= {least}", value)
        require_one_of(NOISES, "noise", self.noise)
        require_one_of(self.PLANNERS, "planner", self.planner)
        require(0.0 <= self.drag_error < 1.0, "drag_error", ">= 0 and < 1", self.drag_error)
        again = self.rate > 0.0
        require(not again or self.planner == "exact", "replan", "0 for other planners", self.rate)
        try:
            self.check_rate()
        except ValueError as error:
            raise SettingError(str(error)) from None

    @property
    def rate(self) -> float:
        """[Hz] of planning anew; only `exact` is planned anew by default."""
        if self.replan is not None:
            return self.replan
        return self.RATE if self.planner == "exact" else 0.0

    def check_rate(self) -> None:
        """Raise `ValueError` unless plans can be made anew at `rate`."""
        NOISES[self.noise].looks_per_plan(self.rate)

    def flight(self) -> Any:
        """The task's `sims.task.FlightTask` with these settings."""
        return pkgutil.resolve_name(self.FLIGHT)(self)


@dataclasses.dataclass(frozen=True)
class CatchFly(FlySettings):
    """Flights that catch thrown balls."""

    replan: float | None = option(None, "HZ", _REPLAN.format(100))
    planner: str = option("exact", "NAME", f"of plans from scratch: {', '.join(CATCH_PLANNERS)}")
    balls: int = option(1, "N", f"thrown {INTERVAL:g} s apart")

    TASK: ClassVar[str] = "catch"
    WORDS: ClassVar[str] = "a quadrotor catches thrown balls with a net"
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.catch:CatchFlight"
    PLANNERS: ClassVar[Mapping[str, str]] = CATCH_PLANNERS
    RATE: ClassVar[float] = 100.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.balls >= 1, "balls", ">= 1", self.balls)

    def check_rate(self) -> None:
        """Raise `ValueError` unless a plan also begins whenever a ball comes into sight."""
        super().check_rate()
        if self.balls > 1:
            require_interval(NOISES[self.noise], self.rate)


@dataclasses.dataclass(frozen=True)
class HitFly(FlySettings):
    """Flights that hit served balls."""

    replan: float | None = option(None, "HZ", _REPLAN.format(50))
    planner: str = option("exact", "NAME", f"of plans from scratch: {', '.join(HIT_PLANNERS)}")
    suite: str = option("S.1", "NAME", "of serves, S.1 to S.6 of the paper")

    TASK: ClassVar[str] = "hit"
    WORDS: ClassVar[str] = "a quadrotor hits served balls to a target with a racket"
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.hit:HitFlight"
    PLANNERS: ClassVar[Mapping[str, str]] = HIT_PLANNERS
    RATE: ClassVar[float] = 50.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(HIT_SUITES, "suite", self.suite)
