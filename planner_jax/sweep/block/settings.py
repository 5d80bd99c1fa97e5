"""What a block sweep is asked to do."""

import dataclasses
import math
from typing import ClassVar

from planner_jax.core.choices import require, require_one_of
from planner_jax.runs.manifest import Entries
from planner_jax.runs.settings import SweepSettings, option

REGIMES = ("R1", "R2", "R3")  # of `planner_jax.robot.arm`, which imports JAX


_LONGEST = 60.0  # [s], or [m] of noise: balls are there for a second or two
_FASTEST = 1000.0  # [Hz]


def require_moderate(name: str, value: float | None, most: float = _LONGEST) -> None:
    """Raise `ArgumentError` unless a value is None, or not negative and no absurd one."""
    if value is not None:
        require(0.0 <= value < math.inf, name, "finite and >= 0", value)
        require(value <= most, name, f"<= {most:g}", value)


def require_frame_rate(value: float) -> None:
    """Raise `ArgumentError` unless the argument `frame_rate` is that of a camera."""
    require(0.0 < value < math.inf, "frame_rate", "finite and > 0", value)
    require(1.0 <= value <= _FASTEST, "frame_rate", f"from 1 to {_FASTEST:g}", value)


@dataclasses.dataclass(frozen=True)
class BlockSettings(SweepSettings):
    """The arguments of a block sweep."""

    regime: str = option(
        "R2",
        "NAME",
        "limits of the joints: R1, those of the paper's authors with the end velocity free; R2, "
        "the data sheet's from rest to rest; R3, R1's from rest to rest",
    )
    wide: bool = option(
        False, "", "the ball may be 0.1 m off the shield's middle and 30 degrees off straight on"
    )
    anywhere: bool = option(False, "", "any place on the shield will do, at any angle")
    delay: float = option(0.0, "S", "seconds until the arm may start")
    planning_budget: float | None = option(
        None,
        "S",
        "seconds after the delay at which motions start; planning runs by the clock, one case "
        "after another, and a motion starts later by what planning took beyond the budget",
    )
    perception: bool = option(
        False, "", "plan with what a camera has seen of the ball; the referee has the true one"
    )
    observe: float = option(0.25, "S", "with --perception: seconds until the flight is fitted")
    overhead: float = option(
        0.05, "S", "with --perception: seconds from a fit until its motion may start"
    )
    replan: float = option(0.0, "HZ", "with --perception: rate of planning anew; 0 for once")
    observe_longer: float = option(
        0.0,
        "S",
        "with --perception: seconds beyond --observe that an arm may go on observing, frame by "
        "frame while it could still meet the ball",
    )
    noise: float = option(
        0.02,
        "M",
        "with --perception: standard deviation of each coordinate; 0 for a stereo camera's",
    )
    frame_rate: float = option(60.0, "HZ", "with --perception: of the camera")

    RUN: ClassVar[str] = "planner_jax.sweep.block.sweep:BlockSweep"
    DRAW: ClassVar[tuple[str, ...]] = ("regime", "wide", "anywhere", "delay")
    CASE_BYTES: ClassVar[int] = 60_000
    CPU_BATCH: ClassVar[int] = 256  # some ms a case
    GPU_BATCH: ClassVar[int] = 4096

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(REGIMES, "regime", self.regime)
        for name in ("delay", "planning_budget", "observe", "overhead", "observe_longer", "noise"):
            require_moderate(name, vars(self)[name])
        require_moderate("replan", self.replan, _FASTEST)
        require_frame_rate(self.frame_rate)
        if self.perception:
            rule = "0 with perception, whose observe and overhead it is"
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
        """Draw options of the task's `draw`: the delay is until the first motion may start."""
        first = (
            self.observe + self.overhead
            if self.perception
            else self.delay + (self.planning_budget or 0.0)
        )
        return {**super().draw_options(), "delay": first}
