"""Settings of runs over many cases of a car that meets one moving target, or a group."""

import dataclasses
from typing import ClassVar

from planner_jax.core.choices import EFFORTS, require_one_of
from planner_jax.runs.settings import SweepSettings, option
from planner_jax.task.group.spec import DECISIONS


@dataclasses.dataclass(frozen=True)
class InterceptSettings(SweepSettings):
    """Settings of a run over many cases of a car that meets one moving target."""

    effort: str = option(EFFORTS[0], "NAME", f"how long the planner searches: {', '.join(EFFORTS)}")

    RUN: ClassVar[str] = "planner_jax.sweep.intercept.sweep:InterceptSweep"
    CASE_BYTES: ClassVar[int] = 100_000
    CPU_BATCH: ClassVar[int] = 256
    GPU_BATCH: ClassVar[int] = 4096
    PLANNER: ClassVar[tuple[str, ...]] = ("effort",)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(EFFORTS, "effort", self.effort)


@dataclasses.dataclass(frozen=True)
class GroupSettings(SweepSettings):
    """Settings of a run over many cases of a car that meets several targets in turn."""

    decide: str = option("best", "NAME", f"decision about the order: {', '.join(DECISIONS)}")

    # Memory of one case [bytes], for which several orders of the targets are planned together.
    CASE_BYTES: ClassVar[int] = 1_000_000
    CPU_BATCH: ClassVar[int] = 64
    GPU_BATCH: ClassVar[int] = 512
    PLANNER: ClassVar[tuple[str, ...]] = ("decide",)
    RUN: ClassVar[str] = "planner_jax.sweep.intercept.sweep:GroupSweep"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(DECISIONS, "decide", self.decide)
