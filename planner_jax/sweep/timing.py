"""Seconds of a sweep: those in which JAX compiled apart from those of warm planning."""

import time
from typing import Any

import jax
import jax.monitoring
import numpy as np

from planner_jax.planning.plan import CaseT, PlanT, plan
from planner_jax.protocol import AnyPlanner, lane

# Tracing, lowering and the backend's compilation, which includes reading the compile cache.
# Inner functions are traced inside outer ones: spans are joined, not added.
_COMPILING = "/jax/core/compile/"
WARM_CALLS = 3  # at most, until nothing is compiled


class CompileClock:
    """Seconds within its block in which JAX traced, lowered or compiled, in any thread."""

    def __init__(self) -> None:
        self._spans: list[tuple[float, float]] = []
        self._last = 0.0

    def __enter__(self) -> "CompileClock":
        jax.monitoring.register_event_time_span_listener(self._listen)
        return self

    def __exit__(self, *_: Any) -> None:
        jax.monitoring.unregister_event_time_span_listener(self._listen)

    def _listen(self, event: str, start_time: float, end_time: float, **kwargs: Any) -> None:
        if event.startswith(_COMPILING):
            self._spans.append((start_time, end_time))

    @property
    def seconds(self) -> float:
        """Length of the union of all spans so far [s]."""
        total, reached = 0.0, 0.0
        for start, end in sorted(self._spans):
            total += max(end - max(start, reached), 0.0)
            reached = max(reached, end)
        return total

    def lap(self) -> float:
        """What `seconds` have grown by since the last call, or since the start."""
        last, self._last = self._last, self.seconds
        return self._last - last

    @property
    def compiled(self) -> bool:
        """Whether anything was compiled."""
        return bool(self._spans)


class Stopwatch:
    """Seconds since the last lap."""

    def __init__(self) -> None:
        self._last = time.perf_counter()

    def lap(self) -> float:
        """Seconds since the last call, or since the start."""
        last, self._last = self._last, time.perf_counter()
        return self._last - last


def timed_plans(planner: AnyPlanner[CaseT, PlanT], cases: CaseT) -> tuple[PlanT, np.ndarray]:
    """Plans of cases (B,), made one after another, and the seconds (B,) that each took.

    A plan in whose time something was compiled is made again; by a planner that compiles in every
    call it is timed with that.
    """
    plans: list[PlanT] = []
    seconds: list[float] = []
    for k in range(jax.tree.leaves(cases)[0].shape[0]):
        case = lane(cases, k)
        for call in range(WARM_CALLS):
            with CompileClock() as clock:
                watch = Stopwatch()
                found = plan(planner, case)
                spent = watch.lap()
            if not clock.compiled or call == WARM_CALLS - 1:
                plans.append(found)
                seconds.append(spent)
                break
    return jax.tree.map(lambda *leaves: np.stack(leaves), *plans), np.array(seconds)
