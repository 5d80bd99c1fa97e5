"""What a catch sweep is asked to do."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar

from planner_jax.sweep.catch.published import PUBLISHED
from planner_jax.sweep.settings import SweepSettings, require, require_one_of
from planner_jax.task.catch.planners import PLANNERS

# As in `planner_jax.task.catch`, `planner_jax.referee.catch`; importing those would load JAX.
SUITES = tuple(PUBLISHED)
DECISIONS = ("best", "greedy", "given")
NET_TESTS = ("plane", "ball")


@dataclasses.dataclass(frozen=True)
class CatchSweep(SweepSettings):
    """The arguments of a catch sweep.

    `limit_scale` is on the speed and body-rate limits and on how far the thrust may be from
    that of hover.

    Raises:
        SettingError: a value breaks its rule.
    """

    suite: str = "throws"
    decide: str = "best"  # how order and first times of the catches are decided
    tolerance: float = 1e-3  # relative, of the referee
    net_test: str = "plane"  # "ball": within the net's radius in any direction

    TASK: ClassVar[str] = "catch"
    DEFAULT_NUM: ClassVar[int] = 1000
    # All orders of six targets are looked at at once: 1 MB a case.
    CPU_BATCH: ClassVar[int] = 1024
    GPU_BATCH: ClassVar[int] = 8192
    PLANNERS: ClassVar[Mapping[str, str]] = PLANNERS

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of(SUITES, "suite", self.suite)
        require_one_of(DECISIONS, "decide", self.decide)
        require_one_of(NET_TESTS, "net_test", self.net_test)
        tolerance = self.tolerance
        require(0.0 <= tolerance < math.inf, "tolerance", "finite and >= 0", tolerance)

    def judgement(self) -> dict[str, Any]:
        """Arguments of the referee."""
        return {"tolerance": self.tolerance, "net_test": self.net_test}
