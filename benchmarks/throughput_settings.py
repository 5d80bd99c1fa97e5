"""What `planner-jax bench throughput` is asked to do; imports no JAX."""

import dataclasses
import pkgutil
from typing import ClassVar

from planner_jax.core.choices import EFFORTS, require, require_memory, require_one_of
from planner_jax.core.registry import task_named
from planner_jax.runs.settings import SweepSettings, option

_MOST = 100_000  # iterations, or calls: an hour and more


@dataclasses.dataclass(frozen=True)
class ThroughputSettings:
    """The arguments of a measurement.

    Raises:
        ArgumentError: a value breaks its rule.
        UnknownName: there is no such task.
    """

    task: str = option("hit", "NAME", "whose cases are planned")
    planner: str | None = option(None, "NAME", "(default: the task's first)")
    suite: str | None = option(None, "NAME", "(default: the task's first)")
    batch: tuple[int, ...] = option((1024, 8192), "B", "plans in one call, one or more sizes")
    devices: int | None = option(None, "N", "how many share a batch (default: all)")
    iterations: int | None = option(None, "K", "of the first round (default: the planner's own)")
    effort: str | None = option(
        None, "NAME", f"of the planner of hits or catches: {', '.join(EFFORTS)}"
    )
    repeat: int = option(5, "R", "timed calls")
    seed: int = option(0, "K", "of the cases")
    agree: bool = option(False, "", "compare the first lanes with those of a CPU, too")

    DESCRIPTION: ClassVar[str] = (
        "Plans a second of batches that stay on the devices, with what the referee says of them,\n"
        "the cost beside a long search's, compile time and memory."
    )

    def __post_init__(self) -> None:
        for name in ("devices", "iterations", "repeat"):
            value = getattr(self, name)
            require(value is None or value >= 1, name, ">= 1", value)
            require(value is None or value <= _MOST, name, f"<= {_MOST}", value)
        if self.effort is not None:
            require_one_of(EFFORTS, "effort", self.effort)
            has_effort = self.task in ("hit", "catch")
            require(has_effort, "effort", f"left out for the task {self.task}", self.effort)
        require(len(self.batch) > 0, "batch", "one or more sizes", shown="none")
        require(min(self.batch) >= 1, "batch", ">= 1", min(self.batch))
        task = task_named(self.task)
        kind: type[SweepSettings] = pkgutil.resolve_name(task.sweep)
        asked = kind(planner=self.planner, suite=self.suite, seed=self.seed).of(task)
        require_memory("batch", max(self.batch), asked.case_bytes)
