"""Settings of sweeps, that is runs over many cases, of a quadrotor that hits a served ball."""

import dataclasses
import math
import os
from collections.abc import Iterable
from typing import ClassVar

from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.runs.manifest import Entries
from planner_jax.runs.settings import option
from planner_jax.sweep.quadrotor_settings import QuadrotorSettings
from planner_jax.task.hit.spec import START

_FARTHEST = 1e6  # [m] greatest absolute coordinate of the start that is accepted


@dataclasses.dataclass(frozen=True)
class HitSettings(QuadrotorSettings):
    """Settings and command-line options of a run over many drawn or published serves to hit."""

    serves: str | None = option(None, "DIR", "read published trial files (default: draw serves)")
    start: tuple[float, ...] | str = option(
        START, "X", "hover start X Y Z in m, or 'uniform' over the half court"
    )
    delay: float = option(0.0, "S", "seconds from the serve to the start of planning")
    drag_after_impact: bool = option(
        False, "", "plan and judge the returned ball with drag too (exact only)"
    )

    TOOL: ClassVar[str] = "racket"
    WITHOUT_EFFORT: ClassVar[str] = "juggle"
    RUN: ClassVar[str] = "planner_jax.sweep.hit.sweep:HitSweep"
    DRAW: ClassVar[tuple[str, ...]] = ("start", "delay", "limit_scale", "robot", "wind", "starts")
    JUDGE: ClassVar[tuple[str, ...]] = ("drag_after_impact",)
    DEFAULT_NUM: ClassVar[int] = 9000
    CASE_BYTES: ClassVar[int] = 12_000
    ROW_BYTES: ClassVar[int] = 1_500
    CPU_BATCH: ClassVar[int] = 4608  # number of serves that the generator draws at once

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0.0 <= self.delay < math.inf, "delay", "finite and >= 0", self.delay)
        truer = not self.drag_after_impact or self.planner in (None, "exact")
        require(truer, "drag_after_impact", "left out unless the planner is exact", self.planner)
        object.__setattr__(self, "start", _check_start(self.start))
        if self.serves is not None:
            object.__setattr__(self, "serves", os.path.abspath(self.serves))

    def planner_options(self) -> Entries:
        """Return the settings that are keyword arguments of the task's function `planner`."""
        truer = {"drag_after_impact": True} if self.drag_after_impact else {}
        return super().planner_options() | truer


def _check_start(start: str | Iterable[float]) -> tuple[float, ...] | str:
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
