"""What a hit sweep is asked to do."""

import dataclasses
import math
import os
from typing import Any, ClassVar

from planner_jax.core.choices import EFFORTS, require, require_scale
from planner_jax.core.errors import ArgumentError
from planner_jax.runs.settings import (
    SweepSettings,
    ending_option,
    ending_options,
    option,
    require_effort,
    require_ending,
)
from planner_jax.sweep.robots import checked_robot, robot_option
from planner_jax.task.hit.spec import START

_FARTHEST = 1e6  # [m]


@dataclasses.dataclass(frozen=True)
class HitSettings(SweepSettings):
    """The arguments of a hit sweep.

    `num` is by default the whole folder, or `DEFAULT_NUM` drawn serves; `seed` is of drawn serves
    and of uniform starts.
    """

    limit_scale: float = option(1.0, "F", "factor on the speed, acceleration and body-rate limits")
    serves: str | None = option(None, "DIR", "read published trial files (default: draw serves)")
    start: tuple[float, ...] | str = option(
        START, "X", "hover start X Y Z in m, or 'uniform' over the half court"
    )
    delay: float = option(0.0, "S", "seconds from the serve to the start of planning")
    drag_after_impact: bool = option(
        False, "", "plan and judge the returned ball with drag too (exact only)"
    )

    robot: Any = robot_option("paper-hitter")
    effort: str = option("feasible", "NAME", f"of the planner: {', '.join(EFFORTS)}")
    ending: str = ending_option()

    RUN: ClassVar[str] = "planner_jax.sweep.hit.sweep:HitSweep"
    DRAW: ClassVar[tuple[str, ...]] = ("start", "delay", "limit_scale", "robot")
    JUDGE: ClassVar[tuple[str, ...]] = ("drag_after_impact",)
    DEFAULT_NUM: ClassVar[int] = 9000
    CASE_BYTES: ClassVar[int] = 12_000
    ROW_BYTES: ClassVar[int] = 1_500
    CPU_BATCH: ClassVar[int] = 4608  # one block of the serve generator

    def __post_init__(self) -> None:
        super().__post_init__()
        require_scale(self.limit_scale)
        require_effort(self.effort, self.planner, "juggle")
        require_ending(self.ending)
        require(0.0 <= self.delay < math.inf, "delay", "finite and >= 0", self.delay)
        truer = not self.drag_after_impact or self.planner in (None, "exact")
        require(truer, "drag_after_impact", "left out unless the planner is exact", self.planner)
        object.__setattr__(self, "start", _checked_start(self.start))
        object.__setattr__(self, "robot", checked_robot(self.robot, "racket"))
        if self.serves is not None:
            object.__setattr__(self, "serves", os.path.abspath(self.serves))

    def planner_options(self) -> dict[str, Any]:
        """Fields of the planner's dataclass that these settings decide."""
        truer = {"drag_after_impact": True} if self.drag_after_impact else {}
        more = {} if self.effort == EFFORTS[0] else {"effort": self.effort}
        return more | truer | ending_options(self.ending)


def _checked_start(start: Any) -> tuple[float, ...] | str:
    rule = f"three finite numbers with z > 0, none beyond {_FARTHEST:g}, or 'uniform'"
    if start in ("uniform", ["uniform"]):
        return "uniform"
    try:
        point = tuple(float(each) for each in start)
    except (TypeError, ValueError):
        raise ArgumentError("start", rule, start) from None
    sound = len(point) == 3 and all(abs(x) <= _FARTHEST for x in point) and point[2] > 0.0
    require(sound, "start", rule, start, shown=" ".join(f"{each:g}" for each in point))
    return point
