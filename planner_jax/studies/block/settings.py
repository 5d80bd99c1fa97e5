"""Settings of runs over many cases that simulate a camera; without JAX."""

import dataclasses
import math

from planner_jax.core.choices import require
from planner_jax.runs.settings import SweepSettings, option

_LONGEST = 60.0  # greatest accepted value of a time [s] or of the noise [m]
_FASTEST = 1000.0  # [Hz] greatest accepted rate of frames or of planning again


def require_moderate(name: str, value: float | None, most: float = _LONGEST) -> None:
    """Raise `ArgumentError` unless the setting `name` is None or a number from 0 to `most`."""
    if value is not None:
        require(0.0 <= value < math.inf, name, "finite and >= 0", value)
        require(value <= most, name, f"<= {most:g}", value)


def require_frame_rate(value: float) -> None:
    """Raise `ArgumentError` unless the setting `frame_rate` is a number from 1 to 1000 Hz."""
    require(0.0 < value < math.inf, "frame_rate", "finite and > 0", value)
    require(1.0 <= value <= _FASTEST, "frame_rate", f"from 1 to {_FASTEST:g}", value)


@dataclasses.dataclass(frozen=True)
class StudySettings(SweepSettings):
    """Settings of a sweep (run over many cases) that may simulate a camera."""

    perception: bool = option(
        False, "", "plan with a camera's observations of the ball; the referee uses the true ball"
    )
    observe: float = option(0.25, "S", "with --perception: seconds until the flight is fitted")
    overhead: float = option(
        0.05, "S", "with --perception: seconds from a fit until its motion may start"
    )
    replan: float = option(0.0, "HZ", "with --perception: rate of planning again; 0 plans once")
    noise: float = option(
        0.02,
        "M",
        "with --perception: standard deviation of each coordinate; 0 simulates a stereo camera",
    )
    frame_rate: float = option(60.0, "HZ", "with --perception: frame rate of the camera")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("observe", "overhead", "noise"):
            require_moderate(name, vars(self)[name])
        require_moderate("replan", self.replan, _FASTEST)
        require_frame_rate(self.frame_rate)

    @property
    def first_motion(self) -> float:
        """Time [s] for observing and planning, before which no arm can start its first motion."""
        return self.observe + self.overhead if self.perception else 0.0
