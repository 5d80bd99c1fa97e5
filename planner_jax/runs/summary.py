"""Success rates and other counts of a run over many cases, computed from its stored rows."""

from collections import Counter
from typing import ClassVar

import numpy as np
import pyarrow as pa
from scipy.stats import binomtest

from planner_jax.runs.manifest import Entries


def wilson_interval(successes: int, num: int) -> tuple[float, float]:
    """Return the 95 % Wilson confidence interval of a success rate; (0, 1) without any trial."""
    if num == 0:
        return 0.0, 1.0
    found = binomtest(successes, num).proportion_ci(0.95, "wilson")
    return float(found.low), float(found.high)


def percent(successes: int, num: int) -> str:
    """Return successes / num in percent as text; only exact 0 and 1 give "0.00" and "100.00"."""
    rate = 100.0 * successes / num
    if 0 < successes < num:
        rate = min(max(rate, 0.01), 99.99)
    return f"{rate:.2f}"


# Columns of a sweep's rows from which its successes and failures are counted.
COUNTED = ("index", "success", "status", "failed_limit")


class Tally:
    """Counts over the planned and judged cases of a run, whose rows are added table by table."""

    READS: ClassVar[tuple[str, ...]] = ()  # columns that are read; () stands for all columns
    MEANS: ClassVar[tuple[str, ...]] = ()  # columns whose mean over the successes is reported

    def __init__(self) -> None:
        self.num = 0
        self.successes = 0
        self.status: Counter[str] = Counter()
        self.failed_limits: Counter[str] = Counter()
        self.example = 0  # index of the case whose plan the report's figures show
        self._example_rank: int | None = None
        self._sums = dict.fromkeys(self.MEANS, 0.0)

    def add(self, rows: pa.Table) -> None:
        """Add rows, one for each planned and judged case, to the counts."""
        success = rows["success"].to_numpy().astype(bool)
        self.num += len(success)
        self.successes += int(success.sum())
        self.status.update(rows["status"].to_numpy())
        self.failed_limits.update(rows["failed_limit"].to_numpy()[~success])
        for name in self.MEANS:
            self._sums[name] += float(rows[name].to_numpy()[success].sum())
        index = rows["index"].to_numpy()
        for rank, there in enumerate(self.examples(rows, success)):
            better = self._example_rank is None or rank < self._example_rank
            if better and there.any():
                self._example_rank, self.example = rank, int(index[there][0])

    def examples(self, rows: pa.Table, success: np.ndarray) -> list[np.ndarray]:
        """Return masks (B,) over B rows, by which the case in the report's figures is chosen.

        The case is the first row that the first non-empty mask selects. `success` (B,) is true for
        rows whose plans the referee accepted.
        """
        return [success, np.ones_like(success)]

    def summary(self) -> Entries:
        """Return success rate, outcome counts, and means of the columns `MEANS` over successes."""
        num = self.successes
        others = {
            f"mean_{name}": total / num if num else None for name, total in self._sums.items()
        }
        return {
            "success_rate": self.successes / self.num,
            "num": self.num,
            "successes": self.successes,
            "wilson_95": list(wilson_interval(self.successes, self.num)),
            "status_counts": dict(self.status.most_common()),
            "failed_limits": dict(self.failed_limits.most_common()),
            **others,
        }
