"""One catch of one ball or several in a few numbers."""

import dataclasses
from typing import ClassVar

from planner_jax.core.choices import require
from planner_jax.core.registry import split_name
from planner_jax.runs.settings import option
from planner_jax.sweep.single_settings import SingleSettings
from planner_jax.task.catch.spec import DECISIONS, TRAINED

_MOST_BALLS = 6  # of which all orders are looked at


@dataclasses.dataclass(frozen=True, kw_only=True)
class SingleCatchSettings(SingleSettings):
    """One ball by `pos` and `vel`, or any number of `balls`, and until when."""

    pos: tuple[float, ...] | None = option(None, "X Y Z", "of the one ball now [m]")
    vel: tuple[float, ...] | None = option(None, "X Y Z", "of the one ball now [m/s]")
    ball: tuple[tuple[float, ...], ...] = option(
        (), "X Y Z VX VY VZ", "place and velocity of a ball now; once for each of several"
    )
    horizon: float = option(dataclasses.MISSING, "S", "until when to catch [s]")
    drag: float | None = option(None, "K", "of the balls, linear [1/s] (default: none)")
    net_height: float | None = option(None, "L", "over the propellers [m] (default: the robot's)")
    net_radius: float | None = option(None, "R", "of the hoop [m] (default: the robot's)")
    max_angle: float | None = option(
        None, "A", "between the net's axis and a ball's way back [rad] (default: the robot's)"
    )
    decide: str = option("best", "NAME", f"order and first times: {', '.join(DECISIONS)}")

    TOOL: ClassVar[str] = "net"
    RUN: ClassVar[str] = "planner_jax.sweep.catch.single:SingleCatch"
    PLANNER: ClassVar[tuple[str, ...]] = ("decide",)
    ELSEWHERE: ClassVar[tuple[str, ...]] = ("pos", "vel", "ball", "horizon", "drag")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("pos", "vel"):
            given = getattr(self, name) is not None
            rule = "left out beside --ball" if self.ball else "given, or --ball"
            require(given != bool(self.ball), name, rule, "both" if given else "nothing")
        num = len(self.ball)
        require(num <= _MOST_BALLS, "ball", f"given at most {_MOST_BALLS} times", num)
        require(self.drag is None or self.drag >= 0.0, "drag", ">= 0", self.drag)
        split_name(DECISIONS, "decide", self.decide, TRAINED)

    @property
    def balls(self) -> list[tuple[tuple[float, ...], tuple[float, ...]]]:
        """Place and velocity of every ball."""
        if self.pos is not None and self.vel is not None:
            return [(self.pos, self.vel)]
        return [(ball[:3], ball[3:]) for ball in self.ball]
