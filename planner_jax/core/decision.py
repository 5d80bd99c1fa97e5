"""Decisions that a case leaves open, and the selection among the plans of several choices."""

from typing import Protocol, runtime_checkable

from jax import Array
from jaxtyping import PyTree

from planner_jax.core.arithmetic import numpy_of
from planner_jax.core.protocol import is_solved


@runtime_checkable
class Decision(Protocol):
    """A rule that decides what a case leaves open, such as the order of its targets; a pytree.

    Examples are the best of all orders, the output of a network, and a fixed order. A class may
    inherit the defaults of `check`, `rank` and `explain`.
    """

    def check(self, cases: PyTree, /) -> None:
        """Raise `ArgumentError` on the host if this decision is not possible for these cases."""

    def propose(self, case: PyTree, /) -> PyTree:
        """Return F choices, such as orders of the targets, best first: arrays (F, ...); pure."""
        ...

    def rank(self, plans: PyTree, /) -> Array:
        """Return a number for each plan, by default its cost; the least one is selected; pure."""
        return plans.cost

    def explain(self, case: PyTree, status: Array, /) -> Array:
        """Return an unsolved case's `status` (), or a status that tells the reason; pure."""
        return status


def index_of_best(plans: PyTree, cost: PyTree = None) -> PyTree:
    """Return the index of the best of K plans (K, ...) per case, by `cost` or the plans' costs."""
    xp = numpy_of(plans.status)
    good = is_solved(plans.status)
    finite = xp.isfinite(plans.cost) & xp.isfinite(plans.violation)
    by_cost = xp.where(good, plans.cost if cost is None else cost, xp.inf)
    by_violation = xp.where(finite, plans.violation, xp.inf)
    return xp.where(good.any(axis=0), by_cost, by_violation).argmin(axis=0)
