"""Options of the command `planner-jax serve`, checked before the slow import of JAX."""

import dataclasses
import pkgutil
from typing import TYPE_CHECKING, Any, ClassVar

from planner_jax.core.choices import require
from planner_jax.runs.settings import option, require_count
from planner_jax.sweep.quadrotor_settings import (
    HEADING,
    MAX_YAW_RATE,
    read_heading,
    resolve_robot,
    robot_option,
)
from planner_jax.task.hit.spec import DRAG

if TYPE_CHECKING:
    from planner_jax.live.strokes import Stroke

PORT = 5560  # default UDP port of the server


@dataclasses.dataclass(frozen=True)
class ServeSettings:
    """Options that `planner-jax serve hit` and `serve catch` share, checked for their ranges."""

    port: int = option(PORT, "N", "UDP port of this machine; 0 selects a free port")
    rate: float = option(100.0, "HZ", "rate of the setpoints in an answer [Hz]")
    horizon: int = option(10, "K", "number of setpoints in an answer")
    deadline: float = option(0.01, "S", "longest time from a packet to its answer [s]")
    noise: float = option(0.005, "M", "standard deviation of an observed coordinate [m]")
    heading: str | float | None = HEADING
    max_yaw_rate: float | None = MAX_YAW_RATE
    seconds: float | None = option(None, "S", "end after this time (default: never)")
    report: bool = option(False, "", "print counts, times and memory at the end")

    STROKE: ClassVar[str]  # name of the class of tasks in `planner_jax.live.strokes`
    TOOL: ClassVar[str]  # tool that the robot must carry, "net" or "racket"
    MOST_DRAG: ClassVar[float]  # greatest accepted drag of the ball, in the unit of the task

    def __post_init__(self) -> None:
        require_count("port", self.port, 0)
        require(self.port < 2**16, "port", f"at most {2**16 - 1}", self.port)
        require(1.0 <= self.rate <= 1000.0, "rate", "from 1 to 1000", self.rate)
        require_count("horizon", self.horizon, 1)
        require(self.horizon <= 17, "horizon", "at most 17", self.horizon)
        require(0.002 <= self.deadline <= 1.0, "deadline", "from 0.002 to 1", self.deadline)
        require(0.001 <= self.noise <= 0.5, "noise", "from 0.001 to 0.5", self.noise)
        if self.seconds is not None:
            require(0.0 < self.seconds <= 1e7, "seconds", "> 0 and at most 1e7", self.seconds)
        object.__setattr__(self, "robot", resolve_robot(vars(self)["robot"], self.TOOL))
        object.__setattr__(self, "heading", read_heading(self.heading))
        drag = vars(self)["drag"]
        require(0.0 <= drag <= self.MOST_DRAG, "drag", f"from 0 to {self.MOST_DRAG:g}", drag)

    def stroke(self) -> "Stroke":
        """Make the task that the server plans, such as a `HitStroke`, from these options."""
        names = {"robot", "target", "drag", "heading", "max_yaw_rate"} & vars(self).keys()
        given = {name: vars(self)[name] for name in names if vars(self)[name] is not None}
        return pkgutil.resolve_name(f"planner_jax.live.strokes:{self.STROKE}")(**given)


@dataclasses.dataclass(frozen=True)
class HitServe(ServeSettings):
    """Options of `planner-jax serve hit`, which returns balls with a racket."""

    robot: Any = robot_option("paper-hitter")
    target: tuple[float, ...] = option((3.0, 0.0, 0.0), "M", "landing position of the ball [m]")
    drag: float = option(DRAG, "K", "quadratic drag K_D of the ball [1/m]")

    STROKE, TOOL, MOST_DRAG = "HitStroke", "racket", 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require(len(self.target) == 3, "target", "3 numbers", len(self.target))
        for value in self.target:
            require(abs(value) <= 100.0, "target", "within 100 m", value)


@dataclasses.dataclass(frozen=True)
class CatchServe(ServeSettings):
    """Options of `planner-jax serve catch`, which catches balls with a net."""

    robot: Any = robot_option("paper-catcher")
    drag: float = option(0.5, "K", "linear drag of the ball [1/s]")

    STROKE, TOOL, MOST_DRAG = "CatchStroke", "net", 10.0


SERVED: dict[str, type[ServeSettings]] = {"hit": HitServe, "catch": CatchServe}
