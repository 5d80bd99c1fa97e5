"""One case of a quadrotor's task in a few numbers, as it is asked for on the command line.

Nothing here imports JAX.
"""

import dataclasses
import math
from typing import Any, ClassVar

from planner_jax.core.choices import require
from planner_jax.core.registry import Task
from planner_jax.runs.settings import (
    ending_option,
    ending_options,
    option,
    require_ending,
)
from planner_jax.sweep.robots import checked_robot, robot_option

_OWN = "(default: the robot's)"


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
    robot: Any = robot_option("the task's")
    ending: str = ending_option("brake")  # its setpoints leave for a controller

    RUN: ClassVar[str]  # what answers, "module:Class"
    PLANNER: ClassVar[tuple[str, ...]] = ()  # names of the settings that are the planner's options
    ELSEWHERE: ClassVar[tuple[str, ...]] = ()  # of those that are no argument of the task's `case`
    TOOL: ClassVar[str]  # that the robot has to carry, "net" or "racket"

    def __post_init__(self) -> None:
        object.__setattr__(self, "robot", checked_robot(self.robot, self.TOOL))
        require_ending(self.ending)
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, list):  # as a parser has it
                value = tuple(tuple(x) if isinstance(x, list) else x for x in value)
                object.__setattr__(self, field.name, value)
            for number in _numbers(value):
                # Only a thrust may have no bound.
                sound = math.isfinite(number) or (field.name == "max_thrust" and number > 0.0)
                require(sound, field.name, "finite", f"{number:g}")

    def of(self, task: Task) -> "SingleSettings":
        """The same with the name of the task's planner filled in, or checked.

        Raises:
            ArgumentError: the task has no planner of the name.
        """
        name = next(iter(task.all_planners())) if self.planner is None else self.planner
        task.split_planner(name)
        return dataclasses.replace(self, planner=name)

    def planner_options(self) -> dict[str, Any]:
        """Options of the planner that these settings decide."""
        own = {name: getattr(self, name) for name in self.PLANNER}
        return own | ending_options(self.ending)

    def case_options(self) -> dict[str, Any]:
        """Named arguments of the task's `case` that are given."""
        apart = {"planner", "ending", *self.PLANNER, *self.ELSEWHERE}
        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {
            name: value for name, value in given.items() if value is not None and name not in apart
        }


def _numbers(value: Any) -> list[float]:
    if isinstance(value, tuple):
        return [number for each in value for number in _numbers(each)]
    return [value] if isinstance(value, float) else []
