"""`replan`: a plan made anew from the one that is being carried out, for what is known now."""

from typing import Any, Generic, TypeVar

import jax
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.checks import numbers_of, require_kind
from planner_jax.core.errors import ArgumentError
from planner_jax.core.planner import require_planner
from planner_jax.core.protocol import Plan
from planner_jax.core.rules import Case
from planner_jax.planning.plan import plan

CaseT = TypeVar("CaseT", bound=Case)
PlanT = TypeVar("PlanT", bound=Plan)


@struct.dataclass
class Replanning(Generic[CaseT, PlanT]):
    """One case for a re-planner, or a batch of them. Times of `case` count from now."""

    case: CaseT  # as it is known now
    previous: PlanT  # that is being carried out; its times began `elapsed` ago
    elapsed: Array | np.ndarray  # () [s]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """() for one case, (B,) for a batch."""
        return self.case.batch_shape


def moment_of(cases: Case, elapsed: PyTree) -> np.ndarray:
    """When plans that are being carried out are left, in the cases' shape and type of numbers.

    Args:
        cases: one case, or a batch.
        elapsed: () or (B,) [s], since the plans began, >= 0.

    Raises:
        TypeError: it is no time.
        ValueError: it is negative or not finite, or of another shape.
    """
    dtypes = (np.asarray(leaf).dtype for leaf in jax.tree.leaves(cases))
    dtype = next(dtype for dtype in dtypes if dtype.kind == "f")
    elapsed = numbers_of("elapsed", elapsed, cases.batch_shape, ()).astype(dtype)
    # As reductions of their own these take a third of what `all` does for one number.
    least = np.minimum.reduce(elapsed, axis=None, initial=np.inf)
    most = np.maximum.reduce(elapsed, axis=None, initial=0.0)
    if not least >= 0.0:
        raise ArgumentError("elapsed", ">= 0", least)
    if not most < np.inf:
        raise ArgumentError("elapsed", "finite", most)
    return elapsed


def given_or_own(name: str, given: PyTree, own: PyTree, elapsed: np.ndarray) -> np.ndarray:
    """What is known of a state, in the shape of a plan's own.

    Args:
        name: of the argument, for messages.
        given: one state, or one a case; the plan's own counts where it is None.
        own: one a case, or one state of one case.
        elapsed: as of `moment_of`, in whose type of numbers it is.

    Raises:
        TypeError: no numbers.
        ValueError: another shape, or not finite.
    """
    if given is None:
        return np.asarray(own, elapsed.dtype)
    batch = elapsed.shape
    found = numbers_of(name, given, batch, np.shape(own)[len(batch) :]).astype(elapsed.dtype)
    if not np.isfinite(found).all():
        raise ArgumentError(name, "finite", given)
    return found


def replan(planner: PyTree, cases: PyTree, previous: PlanT, elapsed: PyTree, **news: Any) -> PlanT:
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
        TypeError: the planner has no re-planner, or cases, plans or news are of another task.
        ValueError: `elapsed` is negative, or plans or news are not one for each case.
    """
    require_planner(planner)
    again = planner.replanner()
    require_kind("cases", cases, again.inner.case_type)
    require_kind("previous", previous, again.plan_type)
    if np.shape(previous.status) != cases.batch_shape:
        raise ArgumentError(
            "previous",
            f"the batch shape of the cases, {cases.batch_shape}",
            np.shape(previous.status),
            verb="have",
        )
    return plan(again, again.begin(cases, previous, elapsed, **news))
