"""What a sweep is asked to do, checked before anything is read, compiled or written."""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, TypeVar

from planner_jax.task.by_name import require_planner

AnySettings = TypeVar("AnySettings", bound="SweepSettings")


class SettingError(ValueError):
    """An argument of a sweep breaks a rule; one line that begins with the argument's name."""


@dataclasses.dataclass(frozen=True)
class SweepSettings:
    """The arguments that the sweeps of all tasks have; a task's own class adds its own.

    Together with those they decide every number of the run's table.

    Raises:
        SettingError: a value breaks its rule.
    """

    planner: str = "exact"
    num: int | None = None  # cases; None: `DEFAULT_NUM`, or all that a source holds
    limit_scale: float = 1.0  # on the limits of the motion
    batch: int | None = None  # cases planned, refereed and written at once; None: by device
    seed: int = 0

    TASK: ClassVar[str]  # its name on the command line
    DEFAULT_NUM: ClassVar[int]
    CPU_BATCH: ClassVar[int]
    GPU_BATCH: ClassVar[int]
    PLANNERS: ClassVar[Mapping[str, str]]  # of the task, by name

    def __post_init__(self) -> None:
        try:
            require_planner(self.PLANNERS, self.planner)
        except ValueError as error:
            raise SettingError(str(error)) from None
        for name, least in (("num", 1), ("batch", 1), ("seed", 0)):
            value = getattr(self, name)
            require(value is None or value >= least, name, f">= {least}", value)
        scale = self.limit_scale
        require(0.0 < scale < math.inf, "limit_scale", "finite and > 0", scale)

    def parameters(self) -> dict[str, Any]:
        """The settings as plain values for `manifest.json`; the class brings them back."""
        return dataclasses.asdict(self)

    def planner_options(self) -> dict[str, Any]:
        """Fields of the planner's dataclass that these settings decide."""
        return {}


def require(holds: bool, name: str, rule: str, value: Any) -> None:
    """Raise `SettingError` unless a rule on an argument holds."""
    if not holds:
        raise SettingError(f"{name} must be {rule}, got {value}")


def require_one_of(names: Iterable[str], name: str, value: str) -> None:
    """Raise `SettingError` unless an argument is one of some words."""
    names = tuple(names)
    require(value in names, name, f"one of {', '.join(names)}", repr(value))


def settings_to_resume(
    kind: type[AnySettings], parameters: dict[str, Any], given: dict[str, Any]
) -> AnySettings:
    """The settings of the run that is resumed, after a check of those given again.

    Args:
        kind: class of the settings.
        parameters: of the run's manifest.
        given: settings that the caller named; they must be the run's.

    Raises:
        SettingError: a given value is not the run's.
    """
    settings = kind(**parameters)
    asked = dataclasses.replace(settings, **given)
    for name in given:
        old, new = getattr(settings, name), getattr(asked, name)
        require(new == old, name, f"{old} as in the run that is resumed", new)
    return settings
