"""Settings of sweeps, that is runs over many cases, of an arm that blocks a thrown ball."""

import dataclasses
import math
from typing import Any, ClassVar

from planner_jax.core.choices import EFFORTS, require, require_one_of
from planner_jax.runs.settings import Options, SweepSettings, option

# Names of the sets of joint limits. They are repeated here, since `robot.arm` would import JAX.
REGIMES = ("R1", "R2", "R3")
_LONGEST = 60.0  # greatest accepted value of a time [s] or of the noise [m]


def require_moderate(name: str, value: float | None, most: float = _LONGEST) -> None:
    """Raise `ArgumentError` unless the setting `name` is None or a number from 0 to `most`."""
    if value is not None:
        require(0.0 <= value < math.inf, name, "finite and >= 0", value)
        require(value <= most, name, f"<= {most:g}", value)


def arm_option() -> Any:
    """Return the option `--arm`, an arm from a file."""
    words = "an arm in MJCF or URDF, with its own limits (default: the IRB 1600)"
    return option(None, "FILE", words)


def tip_option() -> Any:
    """Return the option `--tip`, the end of the arm of `--arm`."""
    words = "body or site of this arm that carries a shield of 0.30 m, if it has none"
    return option(None, "NAME", words)


def scene_option() -> Any:
    """Return the option `--scene`, obstacles and protected body from a file."""
    words = "YAML file of obstacles and protected body, see docs/arms.md (default: the paper's)"
    return option(None, "FILE", words)


def shield_option() -> Any:
    """Return the option `--shield`, the outline of the arm's shield."""
    words = "WIDTHxHEIGHT or disc:RADIUS [m], or a YAML file (default: 0.3x0.3)"
    return option(None, "TEXT", words)


def require_own_limits(arm: str | None, tip: str | None, regime: str) -> None:
    """Raise `ArgumentError` for a tip without an arm, or a regime of the IRB 1600 with an arm."""
    require(arm is not None or tip is None, "tip", "left out without --arm", tip)
    is_usual = arm is None or regime == REGIMES[1]
    require(is_usual, "regime", "left out with --arm, which has limits of its own", regime)


def arm_options(settings: Any) -> Options:
    """Return the arguments of `case` and `draw` for the options of arm, shield and scene."""
    from planner_jax.task.block.scene_file import read_scene, shield_arm  # imports JAX

    own: Options = {}
    if settings.arm is not None or settings.shield is not None:
        own["arm"] = shield_arm(settings.arm, settings.tip, settings.shield)
    if settings.arm is not None:
        own["regime"] = None
    return own if settings.scene is None else own | {"scene": read_scene(settings.scene)}


@dataclasses.dataclass(frozen=True)
class BlockSettings(SweepSettings):
    """Settings and command-line options of a run over many cases of an arm that blocks a ball."""

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
    effort: str = option(EFFORTS[0], "NAME", f"how long the planner searches: {', '.join(EFFORTS)}")
    arm: str | None = arm_option()
    tip: str | None = tip_option()
    scene: str | None = scene_option()
    shield: str | None = shield_option()

    RUN: ClassVar[str] = "planner_jax.sweep.block.sweep:BlockSweep"
    PLANNER: ClassVar[tuple[str, ...]] = ("effort",)
    DRAW: ClassVar[tuple[str, ...]] = ("regime", "wide", "anywhere", "delay")
    CASE_BYTES: ClassVar[int] = 60_000
    CPU_BATCH: ClassVar[int] = 256
    GPU_BATCH: ClassVar[int] = 4096

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(REGIMES, "regime", self.regime)
        require_one_of(EFFORTS, "effort", self.effort)
        require_moderate("delay", self.delay)
        require_own_limits(self.arm, self.tip, self.regime)

    def draw_options(self) -> Options:
        """Return the settings that are keyword arguments of the task's function `draw`."""
        return super().draw_options() | arm_options(self)
