"""Time measurements that separate JAX's compilation from the computation itself."""

import time
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.monitoring
import numpy as np

from planner_jax.core.planner import Planner
from planner_jax.core.protocol import take
from planner_jax.planning.plan import CaseT, PlanT, plan

# Prefix of the names of JAX's events of tracing, lowering, compiling and reading the compile cache.
# Events overlap in time, since functions are traced within functions.
_COMPILING = "/jax/core/compile/"
_WARM_CALLS = 3  # greatest number of calls until one in which JAX compiles nothing

ResultT = TypeVar("ResultT")


class CompileClock:
    """A clock of JAX's tracing, lowering and compilation within a `with` block, in any thread."""

    def __init__(self) -> None:
        self._spans: list[tuple[float, float]] = []
        self._last = 0.0

    def __enter__(self) -> "CompileClock":
        jax.monitoring.register_event_time_span_listener(self._listen)
        return self

    def __exit__(self, *_: object) -> None:
        jax.monitoring.unregister_event_time_span_listener(self._listen)

    def _listen(self, event: str, start_time: float, end_time: float, **kwargs: object) -> None:
        if event.startswith(_COMPILING):
            self._spans.append((start_time, end_time))

    @property
    def seconds(self) -> float:
        """Time [s] in which JAX traced, lowered or compiled; simultaneous work counts once."""
        total, reached = 0.0, 0.0
        for start, end in sorted(self._spans):
            total += max(end - max(start, reached), 0.0)
            reached = max(reached, end)
        return total

    def lap(self) -> float:
        """Return the compile time [s] since the last call of `lap`, or since the block's start."""
        last, self._last = self._last, self.seconds
        return self._last - last

    @property
    def compiled(self) -> bool:
        """True if JAX traced, lowered or compiled anything within the block so far."""
        return bool(self._spans)


class Stopwatch:
    """A clock whose method `lap` returns the seconds since the last call of `lap`."""

    def __init__(self) -> None:
        self._last = time.perf_counter()

    def lap(self) -> float:
        """Return the seconds since the last call of `lap`, or since the clock was created."""
        last, self._last = self._last, time.perf_counter()
        return self._last - last


def measure(call: Callable[[], ResultT]) -> tuple[ResultT, float, bool]:
    """Return a call's result, its duration [s], and whether JAX compiled nothing in the call."""
    watch = Stopwatch()
    with CompileClock() as clock:
        found = call()
    return found, watch.lap(), not clock.compiled


def measure_warm(call: Callable[[], ResultT]) -> tuple[ResultT, float]:
    """Repeat a call, up to three times, until JAX compiles nothing; return result and time [s]."""
    for _ in range(_WARM_CALLS - 1):
        found, seconds, warm = measure(call)
        if warm:
            return found, seconds
    return measure(call)[:2]


def measure_plans(planner: Planner[CaseT, PlanT], cases: CaseT) -> tuple[PlanT, np.ndarray]:
    """Plan cases one by one; return plans, and each case's planning time [s] without compiling."""
    num = jax.tree.leaves(cases)[0].shape[0]
    timed_each = [measure_warm(lambda k=k: plan(planner, take(cases, k))) for k in range(num)]
    plans, seconds = zip(*timed_each, strict=True)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *plans), np.array(seconds)
