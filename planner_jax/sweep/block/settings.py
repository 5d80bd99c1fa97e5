"""Settings of sweeps, that is runs over many cases, of an arm that blocks a thrown ball."""

import dataclasses
import math
from typing import ClassVar

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


@dataclasses.dataclass(frozen=True)
class ArmSettings:
    """The options of arm, shield and scene, which the commands on blocks share."""

    arm: str | None = option(
        None, "FILE", "an arm in MJCF or URDF, with its own limits (default: the IRB 1600)"
    )
    tip: str | None = option(
        None, "NAME", "body or site of this arm that carries a shield of 0.30 m, if it has none"
    )
    scene: str | None = option(
        None,
        "FILE",
        "YAML file of obstacles and protected body, see docs/arms.md (default: the paper's)",
    )
    shield: str | None = option(
        None, "TEXT", "WIDTHxHEIGHT or disc:RADIUS [m], or a YAML file (default: 0.3x0.3)"
    )

    def require_own_limits(self, regime: str) -> None:
        """Raise `ArgumentError` for a tip without an arm, or an IRB 1600's regime with an arm."""
        own = self.arm is not None
        require(own or self.tip is None, "tip", "left out without --arm", self.tip)
        rule = "left out with --arm, which has limits of its own"
        require(not own or regime == REGIMES[1], "regime", rule, regime)

    def arm_options(self) -> Options:
        """Return the arguments of `case` and `draw` that these options specify."""
        from planner_jax.robot.arm_scene_file import read_scene, shield_arm  # imports JAX

        own: Options = {}
        if self.arm is not None or self.shield is not None:
            own["arm"] = shield_arm(self.arm, self.tip, self.shield)
        if self.arm is not None:
            own["regime"] = None
        return own if self.scene is None else own | {"scene": read_scene(self.scene)}


@dataclasses.dataclass(frozen=True)
class BlockSettings(ArmSettings, SweepSettings):
    """Settings and command-line options of a run over many cases of an arm that blocks a ball."""

    regime: str = option(
        "R2",
        "NAME",
        "limits of the joints: R1, of the code of the paper's authors, free end velocity; R2, "
        "speeds of the data sheet, from rest to rest; R3, as R1, from rest to rest",
    )
    wide: bool = option(
        False, "", "accept a ball 0.1 m from the shield's middle and 30 degrees from its normal"
    )
    anywhere: bool = option(False, "", "accept a ball anywhere on the shield, at any angle")
    delay: float = option(0.0, "S", "seconds until the arm may start")
    effort: str = option(EFFORTS[0], "NAME", f"how long the planner searches: {', '.join(EFFORTS)}")

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
        self.require_own_limits(self.regime)

    def draw_options(self) -> Options:
        """Return the settings that are keyword arguments of the task's function `draw`."""
        return super().draw_options() | self.arm_options()
