"""`replan`: a plan made anew from the one that is being carried out, for what is known now."""

from typing import Any, Generic, TypeVar

import jax
import numpy as np
from flax import struct
from jax import Array

from planner_jax.planning.plan import plan
from planner_jax.protocol import Case, Plan

CaseT = TypeVar("CaseT", bound=Case)
PlanT = TypeVar("PlanT", bound=Plan)


@struct.dataclass
class Replanning(Generic[CaseT, PlanT]):
    """One case for a re-planner, or a batch of them. Times of `case` count from now."""

    case: CaseT  # as it is known now
    previous: PlanT  # that is being carried out; its times began `elapsed` ago
    elapsed: Array  # () [s]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """() for one case, (B,) for a batch."""
        return self.case.batch_shape


def moment_of(cases: Case, elapsed: Any) -> np.ndarray:
    """When plans that are being carried out are left, in the cases' shape and type of numbers.

    Args:
        cases: one case, or a batch.
        elapsed: () or (B,) [s], since the plans began, >= 0.

    Raises:
        ValueError: a negative time.
    """
    dtypes = (np.asarray(leaf).dtype for leaf in jax.tree.leaves(cases))
    dtype = next(dtype for dtype in dtypes if np.issubdtype(dtype, np.floating))
    elapsed = np.broadcast_to(np.asarray(elapsed, dtype), cases.batch_shape)
    if not np.all(elapsed >= 0.0):
        raise ValueError(f"elapsed must be >= 0, got {np.min(elapsed)}")
    return elapsed


def given_or_own(given: Any, own: Any, dtype: Any) -> np.ndarray:
    """What is known of a state, in the shape of a plan's own, which counts where it is None."""
    return np.broadcast_to(np.asarray(own if given is None else given, dtype), np.shape(own))


def replan(planner: Any, cases: Any, previous: PlanT, elapsed: Any, **news: Any) -> PlanT:
    """Plan again some time into a plan; a few iterations from what is left of it.

    Args:
        planner: one that has a `replanner`, such as `pj.catch.planner("exact")`, or a re-planner
            with settings of its own, such as `ReplanCatch(shortest=0.2)`.
        cases: what `previous` was planned for, one case or a batch; its times count from where
            the plan began.
        previous: the plan that is being carried out.
        elapsed: () or (B,) [s], since it began, >= 0.
        **news: what has changed, with times that count from now. Catches take `targets` and
            `head_state`, hits `ball`, `drag` and `head_state`. A robot whose `head_state` is not
            given is where the plan has it.

    Returns:
        The plans; their times count from now.

    Raises:
        TypeError: the planner has no re-planner, or the news are of another task.
        ValueError: `elapsed` is negative.
    """
    again = planner.replanner() if hasattr(planner, "replanner") else planner
    if not hasattr(again, "begin"):
        raise TypeError(f"{type(again).__name__} cannot plan again: use the planner exact")
    return plan(again, again.begin(cases, previous, elapsed, **news))
