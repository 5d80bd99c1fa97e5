"""Settings of the sweeps of interceptions and of groups."""

import dataclasses
from typing import ClassVar

from planner_jax.core.choices import require_one_of
from planner_jax.runs.settings import SweepSettings, option
from planner_jax.task.group.spec import DECISIONS


@dataclasses.dataclass(frozen=True)
class InterceptSettings(SweepSettings):
    """Settings of an intercept sweep."""

    RUN: ClassVar[str] = "planner_jax.sweep.intercept.sweep:InterceptSweep"
    CASE_BYTES: ClassVar[int] = 100_000
    CPU_BATCH: ClassVar[int] = 256  # a case takes some milliseconds
    GPU_BATCH: ClassVar[int] = 4096


@dataclasses.dataclass(frozen=True)
class GroupSettings(SweepSettings):
    """Settings of a sweep of groups of targets."""

    decide: str = option("best", "NAME", f"decision about the order: {', '.join(DECISIONS)}")

    CASE_BYTES: ClassVar[int] = 1_000_000  # all finalists of a group are planned together
    CPU_BATCH: ClassVar[int] = 64
    GPU_BATCH: ClassVar[int] = 512
    PLANNER: ClassVar[tuple[str, ...]] = ("decide",)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(DECISIONS, "decide", self.decide)
