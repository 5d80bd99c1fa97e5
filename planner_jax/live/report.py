"""Counts of packets and plans, and computing times of live planning, in constant memory."""

import collections
import contextlib
import math
import time
from collections.abc import Iterator

import jax
import numpy as np

from planner_jax.host.machine import format_size, resident_memory
from planner_jax.live.packets import Fault

_SHORTEST = 1e-6  # [s], lower end of the histogram of times
_STEP = 0.01  # width of a bin of the histogram, relative to its time
_CLASSES = math.ceil(math.log(100.0 / _SHORTEST) / _STEP)  # number of bins, up to 100 s
_COMPILING = "/jax/core/compile/"  # prefix of the events that JAX reports when it compiles


class Latencies:
    """Histogram of computing times [s], with bins 1 % wide from 1 us to 100 s."""

    def __init__(self) -> None:
        self._counts = np.zeros(_CLASSES, np.int64)
        self.num, self.longest = 0, 0.0

    def add(self, seconds: float) -> None:
        """Add one time [s] to the histogram."""
        index = int(math.log(max(seconds, _SHORTEST) / _SHORTEST) / _STEP)
        self._counts[min(index, _CLASSES - 1)] += 1
        self.num, self.longest = self.num + 1, max(self.longest, seconds)

    @contextlib.contextmanager
    def measure(self) -> Iterator[None]:
        """Measure the duration of a `with` block, and add it to the histogram."""
        start = time.perf_counter()
        yield
        self.add(time.perf_counter() - start)

    def quantile(self, share: float) -> float:
        """Return the time [s] that the fraction `share` of all times do not exceed, or NaN."""
        if not self.num:
            return math.nan
        index = int(np.searchsorted(np.cumsum(self._counts), share * self.num))
        return min(_SHORTEST * math.exp(_STEP * (index + 1)), self.longest)


class Report:
    """Report of a run of live planning: counts of packets and plans, times and memory."""

    STAGES = {
        "read": "packet read and checked",
        "estimate": "ball estimated",
        "first": "planned from scratch",
        "again": "planned again",
        "rest": "recovery planned",
        "setpoints": "setpoints made and packed",
        "ball": "ball observed to setpoints sent",
        "answer": "any packet to setpoints sent",
    }

    def __init__(self, deadline: float) -> None:
        self.deadline = deadline
        self.counts: collections.Counter[str] = collections.Counter()
        self.faults: collections.Counter[Fault] = collections.Counter()
        self.stages = {name: Latencies() for name in self.STAGES}
        self.tracking = 0.0  # [m], greatest distance of the robot from its planned position
        self.compiled = 0  # number of compilations after the start
        self._memory: int | None = None

    def begin(self) -> None:
        """Start to count JAX's compilations, and record the memory that the process uses."""
        self._memory = resident_memory()
        jax.monitoring.register_event_duration_secs_listener(self._count_compiled)

    def end(self) -> None:
        """Stop counting compilations."""
        jax.monitoring.unregister_event_duration_listener(self._count_compiled)

    def _count_compiled(self, event: str, duration_secs: float, **_: str | int) -> None:
        self.compiled += event.startswith(_COMPILING)

    def headline(self) -> str:
        """Summarise packets, answers and response times in one line."""
        ball = self.stages["ball"]
        p50, p99 = 1e3 * ball.quantile(0.5), 1e3 * ball.quantile(0.99)
        times = f"from a ball observed to setpoints p50 {p50:.2f} ms, p99 {p99:.2f} ms"
        return (
            f"{self.counts['packets']:,} packets, {self.counts['answered']:,} answered, "
            f"{self.counts['missed']:,} after {1e3 * self.deadline:g} ms; "
            f"{times if ball.num else 'no ball was observed'}"
        )

    def lines(self) -> list[str]:
        """Format the whole report as lines of text: counts, faults, times, memory."""
        lines = [self.headline(), ""]
        lines += [f"{self.counts[name]:>9,}  {words}" for name, words in COUNTS.items()]
        faults = sorted(self.faults.items())
        lines += [f"{num:>9,}  packets: {fault.words}" for fault, num in faults]
        lines += ["", f"{'stage':<32} {'number':>9} {'p50 ms':>8} {'p99 ms':>8} {'max ms':>8}"]
        for name, words in self.STAGES.items():
            stage = self.stages[name]
            times = (stage.quantile(0.5), stage.quantile(0.99), stage.longest)
            shown_times = "".join(f" {1e3 * time:>8.3f}" for time in times)
            lines.append(f"{words:<32} {stage.num:>9,}{shown_times if stage.num else ''}")
        before, now = self._memory, resident_memory()
        if before is not None and now is not None:
            lines += ["", f"memory {format_size(before)} at the start, {format_size(now)} now"]
        lines.append(f"farthest off course {self.tracking:.3f} m")
        lines.append(f"compiled after the start: {self.compiled}")
        return lines


COUNTS = {
    "packets": "packets",
    "answered": "answers",
    "used": "packets used",
    "late": "packets late, and used",
    "missed": "answers after the deadline",
    "busy": "answers from the last plan, as planning took too long",
    "balls": "balls",
    "plans": "plans from scratch that are flown",
    "replans": "plans made again that are flown",
    "refused": "plans that are not flown, as they break a limit",
    "unjoined": "plans that are not flown, as they came too late to join",
    "endless": "plans that are not flown, as no recovery behind them keeps the limits",
    "hard_rests": "recoveries from the robot's state that exceed a limit",
    "astray": "times the robot was off course",
    "clocks": "times the senders' clock was set anew",
    "unsent": "answers that could not be sent",
}
