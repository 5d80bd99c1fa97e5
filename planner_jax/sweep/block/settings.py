"""Settings of a block sweep."""

import dataclasses
import math
from typing import ClassVar

from planner_jax.core.choices import require, require_one_of
from planner_jax.runs.manifest import Entries
from planner_jax.runs.settings import SweepSettings, option

REGIMES = ("R1", "R2", "R3")  # keys in `planner_jax.robot.arm`, which imports JAX
_LONGEST = 60.0  # [s], or [m] of noise; greatest value
_FASTEST = 1000.0  # [Hz], greatest rate


def require_moderate(name: str, value: float | None, most: float = _LONGEST) -> None:
    """Raise `ArgumentError` unless a value is None, or from 0 to `most`."""
    if value is not None:
        require(0.0 <= value < math.inf, name, "finite and >= 0", value)
        require(value <= most, name, f"<= {most:g}", value)


def require_frame_rate(value: float) -> None:
    """Raise `ArgumentError` unless the argument `frame_rate` is possible for a camera."""
    require(0.0 < value < math.inf, "frame_rate", "finite and > 0", value)
    require(1.0 <= value <= _FASTEST, "frame_rate", f"from 1 to {_FASTEST:g}", value)


@dataclasses.dataclass(frozen=True)
class BlockSettings(SweepSettings):
    """Settings of a block sweep."""

    regime: str = option(
        "R2",
        "NAME",
        "limits of the joints: R1, limits of the paper, free end velocity; R2, limits of the data "
        "sheet, from rest to rest; R3, limits of the paper, from rest to rest",
    )
    wide: bool = option(
        False, "", "accept a ball 0.1 m from the shield's middle and 30 degrees from its normal"
    )
    anywhere: bool = option(False, "", "accept a ball anywhere on the shield, at any angle")
    delay: float = option(0.0, "S", "seconds until the arm may start")
    planning_budget: float | None = option(
        None,
        "S",
        "seconds after the delay at which motions start; planning runs by the clock, one case "
        "after another, and a motion starts later by what planning took beyond the budget",
    )
    perception: bool = option(
        False, "", "plan with a camera's observations of the ball; the referee uses the true ball"
    )
    observe: float = option(0.25, "S", "with --perception: seconds until the flight is fitted")
    overhead: float = option(
        0.05, "S", "with --perception: seconds from a fit until its motion may start"
    )
    replan: float = option(0.0, "HZ", "with --perception: rate of planning again; 0 plans once")
    observe_longer: float = option(
        0.0,
        "S",
        "with --perception: seconds beyond --observe in which an arm may continue to observe, "
        "frame by frame while it could still meet the ball",
    )
    noise: float = option(
        0.02,
        "M",
        "with --perception: standard deviation of each coordinate; 0 simulates a stereo camera",
    )
    frame_rate: float = option(60.0, "HZ", "with --perception: frame rate of the camera")

    RUN: ClassVar[str] = "planner_jax.sweep.block.sweep:BlockSweep"
    DRAW: ClassVar[tuple[str, ...]] = ("regime", "wide", "anywhere", "delay")
    CASE_BYTES: ClassVar[int] = 60_000
    CPU_BATCH: ClassVar[int] = 256  # a case takes some milliseconds
    GPU_BATCH: ClassVar[int] = 4096

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(REGIMES, "regime", self.regime)
        for name in ("delay", "planning_budget", "observe", "overhead", "observe_longer", "noise"):
            require_moderate(name, vars(self)[name])
        require_moderate("replan", self.replan, _FASTEST)
        require_frame_rate(self.frame_rate)
        if self.perception:
            rule = "0 with perception, which sets it by observe and overhead"
            require(self.delay == 0.0, "delay", rule, self.delay)
            once = self.replan == 0.0 or self.observe_longer == 0.0
            require(once, "observe_longer", "0 with replan", self.observe_longer)
            require(
                self.planning_budget is None,
                "planning_budget",
                "left out with perception",
                self.planning_budget,
            )

    def draw_options(self) -> Entries:
        """Return the options of the task's `draw`; the delay is the time of the first motion."""
        first = (
            self.observe + self.overhead
            if self.perception
            else self.delay + (self.planning_budget or 0.0)
        )
        return {**super().draw_options(), "delay": first}
