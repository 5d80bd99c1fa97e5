"""What a block sweep is asked to do."""

import dataclasses
import math
from typing import ClassVar

from planner_jax.sweep.settings import SweepSettings, option, require, require_one_of

REGIMES = ("R1", "R2", "R3")  # of `planner_jax.robot.arm`, which imports JAX


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

    RUN: ClassVar[str] = "planner_jax.sweep.block.sweep:BlockSweep"
    DRAW: ClassVar[tuple[str, ...]] = ("regime", "wide", "anywhere", "delay")
    CPU_BATCH: ClassVar[int] = 256  # some ms a case
    GPU_BATCH: ClassVar[int] = 4096

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(REGIMES, "regime", self.regime)
        require(0.0 <= self.delay < math.inf, "delay", "finite and >= 0", self.delay)
