"""What a live loop counts and times, in memory that does not grow, and how that is told."""

import collections
import math
from typing import Any

import jax
import numpy as np

from planner_jax.host.memory import resident_memory, shown
from planner_jax.live.packets import Fault

_SHORTEST = 1e-6  # [s]
_STEP = 0.01  # relative, of the classes of times
_CLASSES = math.ceil(math.log(100.0 / _SHORTEST) / _STEP)
_COMPILING = "/jax/core/compile/"  # of JAX's own events


class Latencies:
    """Times [s] in classes 1 % wide, from 1 us to 100 s."""

    def __init__(self) -> None:
        self._counts = np.zeros(_CLASSES, np.int64)
        self.num, self.longest = 0, 0.0

    def add(self, seconds: float) -> None:
        """Count one."""
        place = int(math.log(max(seconds, _SHORTEST) / _SHORTEST) / _STEP)
        self._counts[min(place, _CLASSES - 1)] += 1
        self.num, self.longest = self.num + 1, max(self.longest, seconds)

    def quantile(self, share: float) -> float:
        """The time [s] below which a share of them lies, to 1 %; NaN of none."""
        if not self.num:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self._counts), share * self.num))
        return min(_SHORTEST * math.exp(_STEP * (place + 1)), self.longest)


class Report:
    """Counts by name, times by stage, memory, and programs that were compiled on the way."""

    STAGES = {
        "read": "packet read and checked",
        "estimate": "ball estimated",
        "first": "planned from scratch",
        "again": "planned again",
        "rest": "way to rest planned",
        "setpoints": "setpoints made and packed",
        "ball": "ball observed to setpoints sent",
        "answer": "any packet to setpoints sent",
    }

    def __init__(self, deadline: float) -> None:
        self.deadline = deadline
        self.counts: collections.Counter[str] = collections.Counter()
        self.faults: collections.Counter[Fault] = collections.Counter()
        self.stages = {name: Latencies() for name in self.STAGES}
        self.tracking = 0.0  # [m], greatest distance of robot and course
        self.compiled = 0
        self._memory: int | None = None

    def begin(self) -> None:
        """Count from now on what is compiled, and remember the memory."""
        self._memory = resident_memory()
        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def end(self) -> None:
        """No longer listen to what is compiled."""
        jax.monitoring.unregister_event_duration_listener(self._heard)

    def _heard(self, event: str, duration_secs: float, **_: str | int) -> None:
        self.compiled += event.startswith(_COMPILING)

    def figures(self) -> dict[str, Any]:
        """All of it, as plain values; times in ms."""
        times = {
            name: {
                "num": stage.num,
                "p50_ms": 1e3 * stage.quantile(0.5),
                "p99_ms": 1e3 * stage.quantile(0.99),
                "max_ms": 1e3 * stage.longest,
            }
            for name, stage in self.stages.items()
        }
        return {
            **{name: self.counts[name] for name in COUNTS},
            "faults": {fault.words: num for fault, num in sorted(self.faults.items())},
            "times": times,
            "farthest_off_course_m": self.tracking,
            "compiled_after_start": self.compiled,
            "memory_bytes": [self._memory, resident_memory()],
        }

    def headline(self) -> str:
        """One line."""
        ball = self.stages["ball"]
        p50, p99 = 1e3 * ball.quantile(0.5), 1e3 * ball.quantile(0.99)
        times = f"from a ball observed to setpoints p50 {p50:.2f} ms, p99 {p99:.2f} ms"
        return (
            f"{self.counts['packets']:,} packets, {self.counts['answered']:,} answered, "
            f"{self.counts['missed']:,} after {1e3 * self.deadline:g} ms; "
            f"{times if ball.num else 'no ball was observed'}"
        )

    def lines(self) -> list[str]:
        """The whole report, to read."""
        lines = [self.headline(), ""]
        lines += [f"{self.counts[name]:>9,}  {words}" for name, words in COUNTS.items()]
        lines += [
            f"{num:>9,}  packets: {fault.words}" for fault, num in sorted(self.faults.items())
        ]
        lines += ["", f"{'stage':<32} {'number':>9} {'p50 ms':>8} {'p99 ms':>8} {'max ms':>8}"]
        for name, words in self.STAGES.items():
            stage = self.stages[name]
            times = (stage.quantile(0.5), stage.quantile(0.99), stage.longest)
            shown_times = "".join(f" {1e3 * time:>8.3f}" for time in times)
            lines.append(f"{words:<32} {stage.num:>9,}{shown_times if stage.num else ''}")
        before, now = self._memory, resident_memory()
        if before is not None and now is not None:
            lines += ["", f"memory {shown(before)} at the start, {shown(now)} now"]
        lines.append(f"farthest off course {self.tracking:.3f} m")
        lines.append(f"compiled after the start: {self.compiled}")
        return lines


COUNTS = {
    "packets": "packets",
    "answered": "answers",
    "used": "packets used",
    "late": "packets late, and used",
    "missed": "answers after the deadline",
    "starved": "of these, for which the machine gave less processor time than the deadline",
    "busy": "answers from the last good plan, as planning took too long",
    "balls": "balls",
    "plans": "plans from scratch that are flown",
    "replans": "plans made again that are flown",
    "refused": "plans that are not flown, as they break a limit",
    "unjoined": "plans that are not flown, as they came too late to join",
    "endless": "plans that are not flown, as no way to rest behind them keeps the limits",
    "hard_rests": "ways to rest from where the robot was that exceed a limit",
    "astray": "times the robot was off course",
    "clocks": "times the senders' clock was set anew",
    "unsent": "answers that could not be sent",
}
