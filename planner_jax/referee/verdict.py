"""The verdict of every referee, and the part that all flights share."""

import dataclasses
from typing import ClassVar

import numpy as np


@dataclasses.dataclass(frozen=True)
class Verdict:
    """The referee's decision on plans, one entry a plan; without an axis for a single plan.

    Measurements of a lane with inputs that are not finite may be NaN.
    """

    # Limit -> sentence for its failure, with `time`, `excess` and any field of the verdict; in the
    # order of the tests: a failed plan is named after its first failure.
    SENTENCES: ClassVar[dict[str, str]]
    # Limit -> sentence for an excess that is infinite.
    UNBOUNDED: ClassVar[dict[str, str]] = {}

    success: np.ndarray  # (B,) bool
    failed_limit: np.ndarray  # (B,) str, the first limit that fails; "" for a success
    failed_time: np.ndarray  # (B,) [s], where that limit is worst; NaN for a success
    # (B,), in the unit of the limit's sentence, tolerance included; NaN for a success.
    failed_excess: np.ndarray

    def sentence(self, k: int | None = None) -> str:
        """Return one line for a human: which limit failed, when, and the excess.

        Args:
            k: index of the plan; None for a verdict on one plan.
        """
        at = () if k is None else k
        name = str(np.asarray(self.failed_limit)[at])
        if not name:
            return f"success: {self.praise(at)}"
        time, excess = np.asarray(self.failed_time)[at], np.asarray(self.failed_excess)[at]
        text = self.UNBOUNDED.get(name) if np.isinf(excess) else None
        found = {field: np.asarray(value)[at] for field, value in vars(self).items()}
        text = (text or self.SENTENCES[name]).format(time=time, excess=excess, **found)
        return f"{name}: {text}"

    def praise(self, k: int | tuple) -> str:
        """Return the end of the sentence for a success."""
        return "every limit holds"


@dataclasses.dataclass(frozen=True)
class FlightVerdict(Verdict):
    """Verdict on plans of a quadrotor, with the measurements of the whole flight."""

    max_speed: np.ndarray  # (B,) [m/s]
    max_acceleration: np.ndarray  # (B,) [m/s^2]
    max_body_rate: np.ndarray  # (B,) [rad/s], infinite where the attitude is not defined
    min_height: np.ndarray  # (B,) [m]
    min_thrust: np.ndarray  # (B,) [m/s^2], per unit mass
    max_thrust: np.ndarray  # (B,) [m/s^2], per unit mass
    # (B,) [N], of one rotor; NaN where the case has no limits of rotors.
    min_rotor_thrust: np.ndarray
    max_rotor_thrust: np.ndarray
    continuity_error: np.ndarray  # (B,) [m], worst jump between pieces, as displacement
    head_error: np.ndarray  # (B,) [m], error at time 0, as displacement
    worst_extra: np.ndarray  # (B,) int, index of the extra with the worst excess; -1 without any
