"""What a run of flights is asked to do, a class a task; the command line is made from its fields.

Nothing here imports JAX or MuJoCo; `FlySettings.flight` does.
"""

import dataclasses
import pkgutil
from typing import Any, ClassVar

from planner_jax.registry import Task, all_tasks
from planner_jax.sims.noise import NOISES, Sensing, require_whole
from planner_jax.sweep.settings import SettingError, option, require, require_one_of
from planner_jax.task.catch.card import TASK as CATCH
from planner_jax.task.hit.card import TASK as HIT

_REPLAN = "plans a second, 0 for the first only (default: {} with exact, 0 with other planners)"
INTERVAL = 0.8  # [s], from throw to throw (paper 000, Fig. 1)


def fly_settings(task: str) -> type["FlySettings"]:
    """The settings of a task's flights.

    Args:
        task: its name in the registry, which knows the settings as the task's `flight`.

    Raises:
        SettingError: there is no task of that name, or it has no flights.
    """
    flown = {name: found.flight for name, found in all_tasks().items() if found.flight}
    require(task in flown, "task", f"one that can be flown ({', '.join(flown)})", repr(task))
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

    TASK: ClassVar[Task]  # with its name and planners
    FLIGHT: ClassVar[str]  # the `FlightTask` that flies it, as "module:Class"
    RATE: ClassVar[float]  # [Hz], of planning anew by default

    def __post_init__(self) -> None:
        for name, least in (("num", 1), ("batch", 1), ("seed", 0)):
            value = getattr(self, name)
            require(value is None or value >= least, name, f">= {least}", value)
        require_one_of(NOISES, "noise", self.noise)
        require_one_of(self.TASK.all_planners(), "planner", self.planner)
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
    planner: str = option("exact", "NAME", "of plans from scratch")
    balls: int = option(1, "N", f"thrown {INTERVAL:g} s apart")

    TASK: ClassVar[Task] = CATCH
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.catch:CatchFlight"
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
    planner: str = option("exact", "NAME", "of plans from scratch")
    suite: str = option("S.1", "NAME", "of serves")

    TASK: ClassVar[Task] = HIT
    FLIGHT: ClassVar[str] = "planner_jax.sims.tasks.hit:HitFlight"
    RATE: ClassVar[float] = 50.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(HIT.suites, "suite", self.suite)
