"""Command-line settings of `planner-jax bench throughput`.

The module does not import JAX, so that the command prints its help quickly.
"""

import dataclasses
import pkgutil
from typing import ClassVar

from planner_jax.core.choices import EFFORTS, require
from planner_jax.core.room import require_memory
from planner_jax.core.tasks import task_named
from planner_jax.runs.settings import Options, SweepSettings, option

_MOST = 100_000  # Maximum of the settings that are counts. Larger counts would take hours.


@dataclasses.dataclass(frozen=True)
class ThroughputSettings:
    """Arguments of a measurement of plans per second.

    Raises:
        ArgumentError: a value is invalid.
        UnknownName: there is no such task, planner or suite.
    """

    task: str = option("hit", "NAME", "task whose cases are planned")
    planner: str | None = option(None, "NAME", "(default: the first of the task)")
    suite: str | None = option(None, "NAME", "(default: the first of the task)")
    batch: tuple[int, ...] = option((1024, 16384), "B", "plans in one call, one or more sizes")
    devices: int | None = option(None, "N", "number of devices that share a batch (default: all)")
    iterations: int | None = option(
        None, "K", "iterations of the first attempt (default: the planner's own)"
    )
    effort: str | None = option(None, "NAME", f"effort of the planner: {', '.join(EFFORTS)}")
    repeat: int = option(5, "R", "number of timed calls")
    seed: int = option(0, "K", "seed of the cases")
    agree: bool = option(False, "", "also compare the first plans with plans of a CPU")

    DESCRIPTION: ClassVar[str] = (
        "Measure plans per second for batches that stay on the devices, with refereed success,\n"
        "the cost above a long search, compile time and memory."
    )

    def __post_init__(self) -> None:
        for name in ("devices", "iterations", "repeat"):
            value = getattr(self, name)
            require(value is None or value >= 1, name, ">= 1", value)
            require(value is None or value <= _MOST, name, f"<= {_MOST}", value)
        require(len(self.batch) > 0, "batch", "one or more sizes", shown="none")
        require(min(self.batch) >= 1, "batch", ">= 1", min(self.batch))
        task = task_named(self.task)
        kind: type[SweepSettings] = pkgutil.resolve_name(task.sweep)
        has_effort = "effort" in {field.name for field in dataclasses.fields(kind)}
        rule = f"left out for the task {self.task}"
        require(has_effort or self.effort is None, "effort", rule, self.effort)
        effort: Options = {} if self.effort is None else {"effort": self.effort}
        sweep = kind(planner=self.planner, suite=self.suite, seed=self.seed, **effort).of(task)
        object.__setattr__(self, "planner", sweep.planner)
        object.__setattr__(self, "suite", sweep.suite)
        require_memory("batch", max(self.batch), sweep.case_bytes)
