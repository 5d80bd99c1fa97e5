"""Settings of runs over many cases in which quadrotors hit or catch."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from planner_jax.core.choices import (
    CHOICES,
    EFFORTS,
    STARTS,
    require,
    require_one_of,
    require_scale,
)
from planner_jax.core.errors import ArgumentError
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.settings import SweepSettings, option, recovery_option, recovery_options

if TYPE_CHECKING:
    from planner_jax.robot.quadrotor_model import QuadrotorModel

_DRAG = "left out unless the file of the robot states its drag"
WIND: Any = option(
    None, "X Y Z", "velocity of the air [m/s], for a robot with drag (default: none)"
)
HEADING: Any = option(
    None, "ANGLE", "of the quadrotor: an angle [rad], velocity or ball (default: 0)"
)
MAX_YAW_RATE: Any = option(None, "W", "of the heading [rad/s] (default: 2)")


def robot_option(usual: str) -> Any:
    """Return the dataclass field of the setting `robot`, in whose help `usual` is the default."""
    words = f"as `planner-jax robots` lists them, or a file .yaml, .yml, .xml (default: {usual})"
    return option(None, "NAME", words)


def read_heading(given: str | float | None) -> str | float | None:
    """Return an option `heading` as a number if it is one, else unchanged: a word, or None."""
    try:
        return float(given)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return given


def resolve_robot(given: object, tool: str, wind: object = None) -> "QuadrotorModel | None":
    """Return the quadrotor that a name, file, model or dict of fields defines; None if not given.

    An `ArgumentError` is raised unless the quadrotor carries `tool`, "net" or "racket", and unless
    it has drag and `wind` has three finite numbers if `wind` is not None.
    """
    if given is None:
        require(wind is None, "wind", _DRAG, wind)
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
    require(wind is None or found.drag is not None, "wind", _DRAG, wind)
    if isinstance(wind, Sequence):
        is_wind = len(wind) == 3 and all(map(math.isfinite, wind))
        require(is_wind, "wind", "three finite numbers", wind)
    return found


def robot_remark(parameters: Row) -> list[str]:
    """Return a sentence on the robot that a run's settings name; [] without a robot."""
    if (robot := parameters.get("robot")) is None:
        return []
    source = f" ({robot['source']})" if robot["source"] else ""
    return [f"Robot: {robot['name']}{source}; its figures stand in manifest.json."]


@dataclasses.dataclass(frozen=True)
class QuadrotorSettings(SweepSettings):
    """Settings of a run over many cases in which quadrotors hit or catch."""

    limit_scale: float = option(1.0, "F", "factor on the limits of speed, body rate and thrust")
    robot: object = robot_option("the task's")
    wind: tuple[float, ...] | None = WIND
    starts: str = option(STARTS[0], "NAME", f"state of the robot at time 0: {' or '.join(STARTS)}")
    effort: str = option(EFFORTS[0], "NAME", f"how long the planner searches: {', '.join(EFFORTS)}")
    recovery: str = recovery_option()

    TOOL: ClassVar[str]  # tool that the robot must carry, "net" or "racket"
    # Name of the planner without search, for which the option `effort` (search length) is rejected.
    WITHOUT_EFFORT: ClassVar[str]

    def __post_init__(self) -> None:
        super().__post_init__()
        require_scale(self.limit_scale)
        object.__setattr__(self, "robot", resolve_robot(self.robot, self.TOOL, self.wind))
        require_one_of(STARTS, "starts", self.starts)
        require_one_of(EFFORTS, "effort", self.effort)
        rule = f"left out for the planner {self.WITHOUT_EFFORT}, which minimises nothing"
        has_effort = self.effort == EFFORTS[0] or self.planner != self.WITHOUT_EFFORT
        require(has_effort, "effort", rule, self.effort)
        require_one_of(CHOICES, "recovery", self.recovery)

    def planner_options(self) -> Entries:
        """Return the settings that are keyword arguments of the task's function `planner`."""
        more = {} if self.effort == EFFORTS[0] else {"effort": self.effort}
        return super().planner_options() | more | recovery_options(self.recovery)
