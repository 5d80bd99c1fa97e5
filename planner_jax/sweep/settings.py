"""What a hit sweep is asked to do, checked before anything is read, compiled or written."""

import dataclasses
import math
import os
from typing import Any

from planner_jax.task.hit.planners import require_planner


class SettingError(ValueError):
    """An argument of a sweep breaks a rule; one line that begins with the argument's name."""


@dataclasses.dataclass(frozen=True)
class HitSweep:
    """The arguments of a hit sweep; together they decide every number of its table.

    Raises:
        SettingError: a value breaks its rule.
    """

    planner: str = "exact"
    serves: str | None = None  # folder of published trial files; None draws serves
    num: int | None = None  # None: the whole folder, or `DEFAULT_NUM` drawn serves
    start: tuple[float, ...] | str = (-3.0, 0.0, 1.5)  # (3,) [m] hover, or "uniform"
    delay: float = 0.0  # [s] from the serve to the moment at which planning begins
    limit_scale: float = 1.0  # on the speed, acceleration and body-rate limits
    drag_after_impact: bool = False  # plan and referee the returned ball with drag
    batch: int | None = None  # cases planned, refereed and written at once; None: by device
    seed: int = 0  # of drawn serves and of uniform starts

    def __post_init__(self) -> None:
        try:
            require_planner(self.planner)
        except ValueError as error:
            raise SettingError(str(error)) from None
        for name, least in (("num", 1), ("batch", 1), ("seed", 0)):
            value = getattr(self, name)
            _require(value is None or value >= least, name, f">= {least}", value)
        _require(0.0 <= self.delay < math.inf, "delay", "finite and >= 0", self.delay)
        scale = self.limit_scale
        _require(0.0 < scale < math.inf, "limit_scale", "finite and > 0", scale)
        truer = not self.drag_after_impact or self.planner == "exact"
        _require(truer, "drag_after_impact", "left out unless the planner is exact", self.planner)
        object.__setattr__(self, "start", _checked_start(self.start))
        if self.serves is not None:
            object.__setattr__(self, "serves", os.path.abspath(self.serves))

    def parameters(self) -> dict[str, Any]:
        """The settings as plain values for `manifest.json`; `HitSweep(**...)` brings them back."""
        return dataclasses.asdict(self)

    def planner_options(self) -> dict[str, Any]:
        """Fields of the planner's dataclass that these settings decide."""
        return {"drag_after_impact": True} if self.drag_after_impact else {}


DEFAULT_NUM = 9000
# Cases a chunk: one block of the serve generator, or what fills a GPU.
CPU_BATCH, GPU_BATCH = 4608, 65536


def _require(holds: bool, name: str, rule: str, value: Any) -> None:
    if not holds:
        raise SettingError(f"{name} must be {rule}, got {value}")


def _checked_start(start: Any) -> tuple[float, ...] | str:
    rule = "three finite numbers with z > 0, or 'uniform'"
    if start == "uniform":
        return start
    try:
        point = tuple(float(number) for number in start)
    except (TypeError, ValueError):
        raise SettingError(f"start must be {rule}, got {start!r}") from None
    sound = len(point) == 3 and all(map(math.isfinite, point)) and point[2] > 0.0
    _require(sound, "start", rule, " ".join(f"{number:g}" for number in point))
    return point


def settings_to_resume(parameters: dict[str, Any], given: dict[str, Any]) -> HitSweep:
    """The settings of the run that is resumed, after a check of those given again.

    Args:
        parameters: of the run's manifest.
        given: settings that the caller named; they must be the run's.

    Raises:
        SettingError: a given value is not the run's.
    """
    settings = HitSweep(**parameters)
    asked = dataclasses.replace(settings, **given)
    for name in given:
        old, new = getattr(settings, name), getattr(asked, name)
        _require(new == old, name, f"{old} as in the run that is resumed", new)
    return settings
