"""What a catch sweep is asked to do."""

import dataclasses
import math
from typing import ClassVar

from planner_jax.core.choices import require, require_one_of
from planner_jax.core.registry import split_name
from planner_jax.runs.settings import option
from planner_jax.sweep.quadrotor_settings import QuadrotorSettings, SingleSettings
from planner_jax.task.catch.spec import DECISIONS, SUITES, TRAINED

_MOST_BALLS = 6  # of which all orders are looked at
NET_TESTS = ("plane", "ball")  # of `referee_catches`


@dataclasses.dataclass(frozen=True)
class CatchSettings(QuadrotorSettings):
    """The arguments of a catch sweep."""

    decide: str = option(
        "best", "NAME", f"order and first times: {', '.join(DECISIONS)}, policy:FILE"
    )
    tolerance: float = option(
        1e-3, "R", "relative, of the referee; the published protocol has 0.05 with --net-test ball"
    )
    net_test: str = option(
        "plane",
        "NAME",
        f"where the net's radius counts, {' or '.join(NET_TESTS)}: across the net in its plane, "
        "or all around its centre",
    )

    TOOL: ClassVar[str] = "net"
    WITHOUT_EFFORT: ClassVar[str] = "mpp"
    RUN: ClassVar[str] = "planner_jax.sweep.catch.sweep:CatchSweep"
    PLANNER: ClassVar[tuple[str, ...]] = ("decide",)
    DRAW: ClassVar[tuple[str, ...]] = ("limit_scale", "robot")
    JUDGE: ClassVar[tuple[str, ...]] = ("tolerance", "net_test")
    GPU_BATCH: ClassVar[int] = 8192  # all orders of six targets at once: 1 MB a case

    def __post_init__(self) -> None:
        super().__post_init__()
        tolerance = self.tolerance
        split_name(DECISIONS, "decide", self.decide, TRAINED)
        require_one_of(NET_TESTS, "net_test", self.net_test)
        require(0.0 <= tolerance < math.inf, "tolerance", "finite and >= 0", tolerance)

    @property
    def case_bytes(self) -> int:
        """More where all orders of several targets are looked at."""
        suite = SUITES.get(self.suite or next(iter(SUITES)))
        all_orders = self.decide == "best" and suite is not None and not suite.optional
        orders = math.factorial(min(suite.num_targets, 6)) if suite and all_orders else 1
        return self.CASE_BYTES + 1_400 * orders


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
            given = vars(self)[name] is not None
            rule = "left out beside --ball" if self.ball else "given, or --ball"
            require(given != bool(self.ball), name, rule, shown="both" if given else "nothing")
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
