"""What a caller is told of plans while they are made, and until when more is begun."""

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt

_QUIET = 1.0  # [s], at least, between two reports of one round


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far a round has come; as text it is one line."""

    round: int  # from 1 on
    rounds: int  # that there are at most
    tried: int  # cases that this round is done with
    cases: int  # that this round is for: those that earlier ones left unsolved
    seconds: float  # since planning began

    def __str__(self) -> str:
        return (
            f"round {self.round} of at most {self.rounds}: {self.tried:,} of {self.cases:,} cases "
            f"tried, after {self.seconds:.1f} s"
        )


class Watch:
    """The clock of one call of `plan`.

    Args:
        time_limit: [s] from now, after which no more is begun; None for no end.
        progress: told where planning has come; None for nobody.

    Raises:
        TypeError: they are no number, and nothing that can be called.
        ValueError: the time is negative or NaN.
    """

    def __init__(
        self,
        time_limit: float | None = None,
        progress: Callable[[Progress], object] | None = None,
    ) -> None:
        if time_limit is not None:
            if isinstance(time_limit, str | bool) or np.ndim(time_limit) != 0:
                raise TypeError(f"time_limit must be a number, got {time_limit!r:.60}")
            if not time_limit >= 0.0:
                raise ValueError(f"time_limit must be >= 0 s, got {time_limit}")
        if progress is not None and not callable(progress):
            raise TypeError(f"progress must be callable, such as print, got {progress!r:.60}")
        self._began, self._limit, self._progress = time.monotonic(), time_limit, progress
        self._told = (0, 0.0)  # round and time of the last report

    @property
    def waits(self) -> bool:
        """Whether each step has to be waited for, as its end is of interest."""
        return self._limit is not None or self._progress is not None

    @property
    def is_over(self) -> bool:
        """Whether the time has passed."""
        return self._limit is not None and time.monotonic() - self._began >= self._limit

    def tell(self, planner: Planner, attempt: Attempt, tried: int, cases: int) -> None:
        """Report of a round: its beginning and its end always, its middle once a second."""
        if self._progress is None:
            return
        seconds, rounds = time.monotonic() - self._began, tuple(planner.attempts)
        place = rounds.index(attempt) + 1 if attempt in rounds else 1
        last_place, last = self._told
        if 0 < tried < cases and place == last_place and seconds - last < _QUIET:
            return
        self._told = place, seconds
        self._progress(Progress(place, max(len(rounds), place), int(tried), int(cases), seconds))
