"""Settings of sweeps and single cases of quadrotors; a manifest holds all of their robot.

Nothing here imports JAX, and robots are imported where one is named, so that a command's help
needs no NumPy.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from planner_jax.core.choices import EFFORTS, require, require_one_of, require_scale
from planner_jax.core.errors import ArgumentError
from planner_jax.core.registry import Task
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.settings import (
    SweepSettings,
    option,
    recovery_option,
    recovery_options,
    require_recovery,
)

if TYPE_CHECKING:
    from planner_jax.robot.quadrotor_model import QuadrotorModel

_OWN = "(default: the robot's)"


def robot_option(usual: str) -> Any:
    """Return the field of settings `robot`, a `QuadrotorModel` or None."""
    words = f"as `planner-jax robots` lists them, or a file .yaml, .yml, .xml (default: {usual})"
    return option(None, "NAME", words)


def checked_robot(given: object, tool: str) -> "QuadrotorModel | None":
    """Return the `QuadrotorModel` that a setting names, or None without one.

    Raises:
        ArgumentError: there is no such robot, its file is not sound, or it carries something else.
    """
    if given is None:
        return None
    from planner_jax.robot.quadrotor_file import RobotError, model_of
    from planner_jax.robot.quadrotor_model import QuadrotorModel
    from planner_jax.robot.quadrotor_models import robot_named

    try:
        found = model_of(given) if isinstance(given, Mapping) else given
        found = robot_named(found) if isinstance(found, str) else found
    except RobotError as error:
        raise ArgumentError("robot", f"a sound one: {error}", shown="") from None
    if not isinstance(found, QuadrotorModel):
        raise ArgumentError("robot", "a name, a file or a QuadrotorModel", given)
    if found.tool.kind != tool:
        shown = f"{found.name!r} with a {found.tool.kind}"
        raise ArgumentError("robot", f"a {tool}", verb="carry", shown=shown)
    return found


def robot_remark(parameters: Row) -> list[str]:
    """Return a sentence on the robot of a run, where one was named."""
    robot = parameters.get("robot")
    if robot is None:
        return []
    source = f" ({robot['source']})" if robot["source"] else ""
    return [f"Robot: {robot['name']}{source}; its figures stand in manifest.json."]


@dataclasses.dataclass(frozen=True)
class QuadrotorSettings(SweepSettings):
    """The arguments of the sweeps of all quadrotor tasks; a task's own class adds its own."""

    limit_scale: float = option(1.0, "F", "factor on the limits of speed, body rate and thrust")
    robot: object = robot_option("the task's")
    effort: str = option(EFFORTS[0], "NAME", f"of the planner: {', '.join(EFFORTS)}")
    recovery: str = recovery_option()

    TOOL: ClassVar[str]  # that the robot has to carry, "net" or "racket"
    WITHOUT_EFFORT: ClassVar[str]  # the planner that minimises nothing

    def __post_init__(self) -> None:
        super().__post_init__()
        require_scale(self.limit_scale)
        object.__setattr__(self, "robot", checked_robot(self.robot, self.TOOL))
        require_one_of(EFFORTS, "effort", self.effort)
        rule = f"left out for the planner {self.WITHOUT_EFFORT}, which minimises nothing"
        has_effort = self.effort == EFFORTS[0] or self.planner != self.WITHOUT_EFFORT
        require(has_effort, "effort", rule, self.effort)
        require_recovery(self.recovery)

    def planner_options(self) -> Entries:
        """Return the options of the planner that these settings decide."""
        more = {} if self.effort == EFFORTS[0] else {"effort": self.effort}
        return super().planner_options() | more | recovery_options(self.recovery)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SingleSettings:
    """What the single cases of all quadrotor tasks have; a task's own class adds its own.

    A field of several numbers has as many words in its `metavar`.

    Raises:
        ArgumentError: a value breaks a rule.
    """

    planner: str | None = option(None, "NAME", "")  # None: the task's first
    start: tuple[float, ...] | None = option(None, "X Y Z", "where the quadrotor hovers [m]")
    speed: float | None = option(None, "V", f"greatest speed [m/s] {_OWN}")
    body_rate: float | None = option(None, "W", f"greatest body rate [rad/s] {_OWN}")
    min_thrust: float | None = option(None, "A", f"least thrust over mass [m/s^2] {_OWN}")
    max_thrust: float | None = option(None, "A", f"greatest thrust over mass [m/s^2] {_OWN}")
    min_height: float | None = option(None, "Z", f"least height [m] {_OWN}")
    gravity: float | None = option(None, "G", "magnitude [m/s^2] (default: the task's)")
    robot: object = robot_option("the task's")
    recovery: str = recovery_option("brake")  # its setpoints leave for a controller

    RUN: ClassVar[str]  # what answers, "module:Class"
    PLANNER: ClassVar[tuple[str, ...]] = ()  # names of the settings that are the planner's options
    ELSEWHERE: ClassVar[tuple[str, ...]] = ()  # of those that are no argument of the task's `case`
    TOOL: ClassVar[str]  # that the robot has to carry, "net" or "racket"

    def __post_init__(self) -> None:
        object.__setattr__(self, "robot", checked_robot(self.robot, self.TOOL))
        require_recovery(self.recovery)
        for field in dataclasses.fields(self):
            value = vars(self)[field.name]
            if isinstance(value, list):  # as a parser has it
                value = tuple(tuple(x) if isinstance(x, list) else x for x in value)
                object.__setattr__(self, field.name, value)
            for number in _numbers(value):
                # Only a thrust may have no bound.
                sound = math.isfinite(number) or (field.name == "max_thrust" and number > 0.0)
                require(sound, field.name, "finite", f"{number:g}")

    def of(self, task: Task) -> "SingleSettings":
        """Return the same with the name of the task's planner filled in, or checked.

        Raises:
            ArgumentError: the task has no planner of the name.
        """
        name = next(iter(task.all_planners())) if self.planner is None else self.planner
        task.split_planner(name)
        return dataclasses.replace(self, planner=name)

    def planner_options(self) -> Entries:
        """Return options of the planner that these settings decide."""
        own = {name: vars(self)[name] for name in self.PLANNER}
        return own | recovery_options(self.recovery)

    def case_options(self) -> Entries:
        """Named arguments of the task's `case` that are given."""
        apart = {"planner", "recovery", *self.PLANNER, *self.ELSEWHERE}
        given = vars(self).items()
        return {name: value for name, value in given if value is not None and name not in apart}


def _numbers(value: object) -> list[float]:
    if isinstance(value, tuple):
        return [number for each in value for number in _numbers(each)]
    return [value] if isinstance(value, float) else []
