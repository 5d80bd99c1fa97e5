"""What every referee says of a plan."""

import dataclasses
from typing import ClassVar

import numpy as np


@dataclasses.dataclass(frozen=True)
class Verdict:
    """The referee's word on plans, one entry a plan; without an axis for one plan alone."""

    # Limit -> what is said when it fails, with `time`, `excess` and any field of the verdict; in
    # the order of the tests.
    SENTENCES: ClassVar[dict[str, str]]
    # The same for an excess that is infinite.
    UNBOUNDED: ClassVar[dict[str, str]] = {}

    success: np.ndarray  # (B,) bool
    failed_limit: np.ndarray  # (B,) str, the first limit that fails; "" for a success
    failed_time: np.ndarray  # (B,) [s], where that limit is worst; NaN for a success
    # (B,) by how much, in the unit that the limit's sentence has; NaN for a success. It is the
    # whole error, the tolerance not taken off.
    failed_excess: np.ndarray

    def sentence(self, k: int | None = None) -> str:
        """One line for a human: which limit failed, when, and by how much.

        Args:
            k: place of the plan; none for a verdict on one plan.
        """
        at = () if k is None else k
        name = str(np.asarray(self.failed_limit)[at])
        if not name:
            return f"success: {self.praise(at)}"
        time, excess = np.asarray(self.failed_time)[at], np.asarray(self.failed_excess)[at]
        text = self.UNBOUNDED.get(name) if np.isinf(excess) else None
        found = {f.name: np.asarray(getattr(self, f.name))[at] for f in dataclasses.fields(self)}
        text = (text or self.SENTENCES[name]).format(time=time, excess=excess, **found)
        return f"{name}: {text}"

    def praise(self, k: int | tuple) -> str:
        """What is said of a success."""
        return "every limit holds"
