"""What a hit sweep is asked to do."""

import dataclasses
import math
import os
from collections.abc import Mapping
from typing import Any, ClassVar

from planner_jax.sweep.settings import SettingError, SweepSettings, require
from planner_jax.task.hit.planners import PLANNERS


@dataclasses.dataclass(frozen=True)
class HitSweep(SweepSettings):
    """The arguments of a hit sweep.

    `num` is by default the whole folder, or `DEFAULT_NUM` drawn serves; `limit_scale` is on the
    speed, acceleration and body-rate limits; `seed` is of drawn serves and of uniform starts.

    Raises:
        SettingError: a value breaks its rule.
    """

    serves: str | None = None  # folder of published trial files; None draws serves
    start: tuple[float, ...] | str = (-3.0, 0.0, 1.5)  # (3,) [m] hover, or "uniform"
    delay: float = 0.0  # [s] from the serve to the moment at which planning begins
    drag_after_impact: bool = False  # plan and referee the returned ball with drag

    TASK: ClassVar[str] = "hit"
    DEFAULT_NUM: ClassVar[int] = 9000
    # One block of the serve generator, or what fills a GPU.
    CPU_BATCH: ClassVar[int] = 4608
    GPU_BATCH: ClassVar[int] = 65536
    PLANNERS: ClassVar[Mapping[str, str]] = PLANNERS

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0.0 <= self.delay < math.inf, "delay", "finite and >= 0", self.delay)
        truer = not self.drag_after_impact or self.planner == "exact"
        require(truer, "drag_after_impact", "left out unless the planner is exact", self.planner)
        object.__setattr__(self, "start", _checked_start(self.start))
        if self.serves is not None:
            object.__setattr__(self, "serves", os.path.abspath(self.serves))

    def planner_options(self) -> dict[str, Any]:
        """Fields of the planner's dataclass that these settings decide."""
        return {"drag_after_impact": True} if self.drag_after_impact else {}


def _checked_start(start: Any) -> tuple[float, ...] | str:
    rule = "three finite numbers with z > 0, or 'uniform'"
    if start == "uniform":
        return start
    try:
        point = tuple(float(number) for number in start)
    except (TypeError, ValueError):
        raise SettingError(f"start must be {rule}, got {start!r}") from None
    sound = len(point) == 3 and all(map(math.isfinite, point)) and point[2] > 0.0
    require(sound, "start", rule, " ".join(f"{number:g}" for number in point))
    return point
