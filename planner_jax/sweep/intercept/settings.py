"""Settings of runs over many cases of a car that meets one moving target, or a group."""

import dataclasses
from typing import ClassVar, Self

from planner_jax.core.choices import EFFORTS, require, require_one_of
from planner_jax.core.registry import Task
from planner_jax.runs.settings import SweepSettings, option
from planner_jax.task.group.spec import DECISIONS, MOST_PERMUTED, SUITES


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

    decide: str | None = option(
        None,
        "NAME",
        f"decision about the order: {', '.join(DECISIONS)} (default: best; search for more than "
        f"{MOST_PERMUTED} targets, which the planner direct meets by default)",
    )

    # Memory of one case [bytes], for which several orders of the targets are planned together.
    CASE_BYTES: ClassVar[int] = 1_000_000
    CPU_BATCH: ClassVar[int] = 64
    GPU_BATCH: ClassVar[int] = 512
    PLANNER: ClassVar[tuple[str, ...]] = ("decide",)
    RUN: ClassVar[str] = "planner_jax.sweep.intercept.sweep:GroupSweep"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.decide is not None:
            require_one_of(DECISIONS, "decide", self.decide)

    @property
    def has_many(self) -> bool:
        """True if cases of the suite have too many targets to estimate all their orders."""
        suite = SUITES.get(self.suite or next(iter(SUITES)))
        return suite is not None and suite.num_targets[1] > MOST_PERMUTED

    def of(self, task: Task) -> Self:
        """Return the settings; planner and decision that are None become those of the suite."""
        planner, decide = ("direct", "search") if self.has_many else (None, "best")
        rule = f"search or greedy for suite {self.suite}, with more than {MOST_PERMUTED} targets"
        require(not self.has_many or self.decide != "best", "decide", rule, self.decide)
        own = {"planner": self.planner or planner, "decide": self.decide or decide}
        return super(GroupSettings, dataclasses.replace(self, **own)).of(task)
