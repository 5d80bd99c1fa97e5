"""Options of the command `planner-jax plan` for each task, checked before JAX is imported."""

import dataclasses
import math
from dataclasses import MISSING
from typing import ClassVar, Self

from planner_jax.core.choices import CHOICES, require, require_one_of
from planner_jax.core.registry import Task, split_name
from planner_jax.runs.manifest import Entries
from planner_jax.runs.settings import option, recovery_option, recovery_options
from planner_jax.sweep.block.settings import REGIMES, ArmSettings
from planner_jax.sweep.quadrotor_settings import (
    HEADING,
    MAX_YAW_RATE,
    WIND,
    read_heading,
    resolve_robot,
    robot_option,
)
from planner_jax.task.catch.spec import DECISIONS, TRAINED
from planner_jax.task.hit.spec import DRAG

_OWN = "(default: the robot's)"
# Greatest number of balls. The planner evaluates all orders of the catches, 720 for six balls.
_MOST_BALLS = 6


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanSettings:
    """Options of `planner-jax plan` for any task; a subclass adds options of one task.

    Each field is an option. Its `metavar`, such as "X Y Z", has one word for each number of the
    option's value.
    """

    planner: str | None = option(None, "NAME", "")  # None selects the first planner of the task

    RUN: ClassVar[str]  # subclass of `Single` that runs the command, as "module:Class"

    def of(self, task: Task) -> Self:
        """Check the planner's name; return a copy with the task's first planner instead of None."""
        name = next(iter(task.all_planners())) if self.planner is None else self.planner
        task.split_planner(name)
        return dataclasses.replace(self, planner=name)

    def planner_options(self) -> Entries:
        """Return the planner's options that these settings specify, by name."""
        return {}


@dataclasses.dataclass(frozen=True, kw_only=True)
class SingleInterceptSettings(PlanSettings):
    """Options of `planner-jax plan intercept`: the file of a case."""

    map: str = option(MISSING, "FILE", "YAML or JSON file with the arguments of pj.intercept.case")

    RUN: ClassVar[str] = "planner_jax.cli.plan.intercept:SingleIntercept"


@dataclasses.dataclass(frozen=True, kw_only=True)
class SingleBlockSettings(ArmSettings, PlanSettings):
    """Options of `planner-jax plan block`: ball, limits of the joints, and tolerances."""

    pos: tuple[float, ...] = option(MISSING, "X Y Z", "initial position of the ball [m]")
    vel: tuple[float, ...] = option(MISSING, "X Y Z", "initial velocity of the ball [m/s]")
    delay: float = option(0.0, "S", "seconds until the arm may start")
    regime: str = option("R2", "NAME", f"limits of the joints: {', '.join(REGIMES)}")
    wide: bool = option(False, "", "accept a ball 0.1 m from the shield's middle, at 30 degrees")
    no_pole: bool = option(False, "", "leave out the pole before the arm")
    view: bool = option(False, "", "play the plan in a browser until Ctrl-C")

    RUN: ClassVar[str] = "planner_jax.cli.plan.block:SingleBlock"

    def __post_init__(self) -> None:
        require_one_of(REGIMES, "regime", self.regime)
        self.require_own_limits(self.regime)
        is_one = not self.no_pole or self.scene is None
        require(is_one, "no_pole", "left out with --scene, which lists all obstacles", self.no_pole)
        for name in ("pos", "vel"):
            numbers = tuple(vars(self)[name])
            object.__setattr__(self, name, numbers)
            for number in numbers:
                require(math.isfinite(number), name, "finite", number)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SingleSettings(PlanSettings):
    """Options of `planner-jax plan` for hits and catches; a subclass adds options of one task.

    A number that is not finite, or an unknown name, raises `ArgumentError`.
    """

    start: tuple[float, ...] | None = option(None, "X Y Z", "where the quadrotor starts [m]")
    start_velocity: tuple[float, ...] | None = option(
        None, "X Y Z", "of the quadrotor at the start [m/s] (default: none)"
    )
    start_acceleration: tuple[float, ...] | None = option(
        None, "X Y Z", "of the quadrotor at the start [m/s^2] (default: none)"
    )
    start_attitude: tuple[float, ...] | None = option(
        None, "W X Y Z", "at the start, instead of the acceleration, with a thrust of the weight"
    )
    heading: str | float | None = HEADING
    max_yaw_rate: float | None = MAX_YAW_RATE
    speed: float | None = option(None, "V", f"greatest speed [m/s] {_OWN}")
    body_rate: float | None = option(None, "W", f"greatest body rate [rad/s] {_OWN}")
    min_thrust: float | None = option(None, "A", f"least thrust over mass [m/s^2] {_OWN}")
    max_thrust: float | None = option(None, "A", f"greatest thrust over mass [m/s^2] {_OWN}")
    min_height: float | None = option(None, "Z", f"least height [m] {_OWN}")
    gravity: float | None = option(None, "G", "magnitude [m/s^2] (default: the task's)")
    robot: object = robot_option("the task's")
    wind: tuple[float, ...] | None = WIND
    recovery: str = recovery_option("brake")  # "brake", since controllers need a stop at the end

    PLANNER: ClassVar[tuple[str, ...]] = ()  # names of fields that are arguments of the planner
    ELSEWHERE: ClassVar[tuple[str, ...]] = ()  # names of fields that are no argument of `task.case`
    TOOL: ClassVar[str]  # tool that the robot must carry, "net" or "racket"

    def __post_init__(self) -> None:
        object.__setattr__(self, "robot", resolve_robot(self.robot, self.TOOL, self.wind))
        require_one_of(CHOICES, "recovery", self.recovery)
        object.__setattr__(self, "heading", read_heading(self.heading))
        for field in dataclasses.fields(self):
            value = vars(self)[field.name]
            if isinstance(value, list):  # argparse returns several numbers as a list
                value = tuple(tuple(x) if isinstance(x, list) else x for x in value)
                object.__setattr__(self, field.name, value)
            for number in _numbers(value):
                # Only `max_thrust` may be infinite, which means that the thrust has no upper limit.
                sound = math.isfinite(number) or (field.name == "max_thrust" and number > 0.0)
                require(sound, field.name, "finite", number)

    def planner_options(self) -> Entries:
        """Return the planner's options that these settings specify, by name."""
        return {name: vars(self)[name] for name in self.PLANNER} | recovery_options(self.recovery)

    def case_options(self) -> Entries:
        """Return the keyword arguments of `task.case`: the options that are not None."""
        apart = {"planner", "recovery", *self.PLANNER, *self.ELSEWHERE}
        given = vars(self).items()
        return {name: value for name, value in given if value is not None and name not in apart}


def _numbers(value: object) -> list[float]:
    if isinstance(value, tuple):
        return [number for each in value for number in _numbers(each)]
    return [value] if isinstance(value, float) else []


@dataclasses.dataclass(frozen=True, kw_only=True)
class SingleHitSettings(SingleSettings):
    """Options of `planner-jax plan hit`: ball, target, limits, and constants of racket and ball."""

    pos: tuple[float, ...] = option(MISSING, "X Y Z", "initial position of the ball [m]")
    vel: tuple[float, ...] = option(MISSING, "X Y Z", "initial velocity of the ball [m/s]")
    target: tuple[float, ...] = option(MISSING, "X Y Z", "desired landing point [m]")
    acceleration: float | None = option(None, "A", "greatest [m/s^2] (default: the robot's)")
    hitting_speed: tuple[float, ...] | None = option(
        None, "X Y Z", "greatest at the impact, by axis [m/s] (default: 4 3 4)"
    )
    min_apex: float | None = option(None, "Z", "of the returned ball [m] (default: 2.2)")
    max_apex: float | None = option(None, "Z", "of the returned ball [m] (default: 6.2)")
    restitution: float | None = option(None, "B", "of the racket (default: the robot's)")
    drag: float | None = option(None, "K", f"of the ball, quadratic [1/m] (default: {DRAG})")

    TOOL: ClassVar[str] = "racket"
    RUN: ClassVar[str] = "planner_jax.cli.plan.hit:SingleHit"
    ELSEWHERE: ClassVar[tuple[str, ...]] = ("pos", "vel", "target")


@dataclasses.dataclass(frozen=True, kw_only=True)
class SingleCatchSettings(SingleSettings):
    """Options of `planner-jax plan catch`: one ball by `pos` and `vel`, or several by `ball`."""

    pos: tuple[float, ...] | None = option(None, "X Y Z", "initial position of the only ball [m]")
    vel: tuple[float, ...] | None = option(None, "X Y Z", "initial velocity of the only ball [m/s]")
    ball: tuple[tuple[float, ...], ...] = option(
        (), "X Y Z VX VY VZ", "initial position and velocity of a ball; repeat it for several balls"
    )
    horizon: float = option(MISSING, "S", "latest time of a catch [s]")
    drag: float | None = option(None, "K", "of the balls, linear [1/s] (default: none)")
    net_height: float | None = option(None, "L", "over the propellers [m] (default: the robot's)")
    net_radius: float | None = option(None, "R", "of the hoop [m] (default: the robot's)")
    max_angle: float | None = option(
        None, "A", "between net's axis and reversed velocity of a ball [rad] (default: the robot's)"
    )
    decide: str = option("best", "NAME", f"order and first times: {', '.join(DECISIONS)}")

    TOOL: ClassVar[str] = "net"
    RUN: ClassVar[str] = "planner_jax.cli.plan.catch:SingleCatch"
    PLANNER: ClassVar[tuple[str, ...]] = ("decide",)
    ELSEWHERE: ClassVar[tuple[str, ...]] = ("pos", "vel", "ball", "horizon", "drag")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("pos", "vel"):
            given = vars(self)[name] is not None
            rule = "left out beside --ball" if self.ball else "given, or --ball"
            require(given != bool(self.ball), name, rule, shown="both" if given else "nothing")
        num = len(self.ball)
        require(num <= _MOST_BALLS, "ball", f"given at most {_MOST_BALLS} times", num)
        require(self.drag is None or self.drag >= 0.0, "drag", ">= 0", self.drag)
        split_name(DECISIONS, "decide", self.decide, TRAINED)

    @property
    def balls(self) -> list[tuple[tuple[float, ...], tuple[float, ...]]]:
        """Position [m] and velocity [m/s] of every specified ball."""
        if self.pos is not None and self.vel is not None:
            return [(self.pos, self.vel)]
        return [(ball[:3], ball[3:]) for ball in self.ball]
