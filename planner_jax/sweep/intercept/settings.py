"""What an intercept sweep is asked to do."""

import dataclasses
from typing import ClassVar

from planner_jax.runs.settings import SweepSettings


@dataclasses.dataclass(frozen=True)
class InterceptSettings(SweepSettings):
    """The arguments of an intercept sweep."""

    RUN: ClassVar[str] = "planner_jax.sweep.intercept.sweep:InterceptSweep"
    CASE_BYTES: ClassVar[int] = 100_000
    CPU_BATCH: ClassVar[int] = 256  # some ms a case
    GPU_BATCH: ClassVar[int] = 4096
