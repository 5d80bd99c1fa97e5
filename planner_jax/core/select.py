"""Which of several plans of a case is selected: one rule for every planner.

A plan that keeps every limit is selected before one that does not. Of two that keep them the
cheaper one is selected, and of two that do not the one that exceeds them less. The functions take
NumPy or jax arrays, and anything with `cost`, `violation` and, without a `tolerance`, `status`.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.protocol import Plan, is_solved

PlanT = TypeVar("PlanT", bound=Plan)


def is_better(
    later: PyTree, before: PyTree, *, tolerance: float | None = None, share: float = 1.0
) -> PyTree:
    """Return whether later plans are selected in the place of earlier ones, bool.

    Args:
        later: plans of any batch shape.
        before: plans of the same cases.
        tolerance: the greatest violation at which a plan counts as keeping every limit. By default
            its status says so.
        share: of the earlier cost, below which a plan that keeps limits, too, is cheaper.
    """
    if tolerance is None:
        is_good, was_good = is_solved(later.status), is_solved(before.status)
    else:
        is_good, was_good = later.violation <= tolerance, before.violation <= tolerance
    xp: Any = jnp if isinstance(was_good, jax.Array) else np
    is_cheaper = is_good & (later.cost < share * before.cost)
    is_farther = before.violation <= later.violation  # false, too, where either is NaN
    is_nearer = xp.isfinite(later.violation) & xp.logical_not(is_farther)
    return xp.where(was_good, is_cheaper, is_good | is_nearer)


def select(later: PlanT, before: PlanT, where: Array | bool = True) -> PlanT:
    """Return the plans, with later ones where these are better; pure.

    Args:
        later: plans of any batch shape.
        before: plans of the same cases.
        where: cases whose plans may change.
    """
    chosen = jnp.asarray(where & is_better(later, before))

    def pick(old: Array, new: Array) -> Array:
        return jnp.where(chosen.reshape(chosen.shape + (1,) * (new.ndim - chosen.ndim)), new, old)

    return jax.tree.map(pick, before, later)


def select_into(plans: PyTree, later: PyTree, lanes: np.ndarray) -> PyTree:
    """Return plans with NumPy leaves, changed in place where later plans of some lanes are better.

    Args:
        plans: a batch.
        later: plans of `lanes`, or of more lanes than these.
        lanes: indices of the batch.
    """
    later = jax.tree.map(lambda leaf: np.asarray(leaf)[: lanes.size], later)
    better = is_better(later, jax.tree.map(lambda leaf: leaf[lanes], plans))

    def replace(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        old[lanes[better]] = new[better]
        return old

    return jax.tree.map(replace, plans, later)


def index_of_best(plans: PyTree, cost: PyTree = None) -> PyTree:
    """Return the index along the first axis of the plan that is selected of each case's.

    Args:
        plans: the plans of a case one after another, (K, ...).
        cost: (K, ...), in the place of the planner's own.
    """
    xp: Any = jnp if isinstance(plans.status, jax.Array) else np
    good = is_solved(plans.status)
    finite = xp.isfinite(plans.cost) & xp.isfinite(plans.violation)
    by_cost = xp.where(good, plans.cost if cost is None else cost, xp.inf)
    by_violation = xp.where(finite, plans.violation, xp.inf)
    return xp.where(good.any(axis=0), by_cost, by_violation).argmin(axis=0)


def first_solved(plan_of: Callable[[Array], PlanT], num: Array | int, best: PlanT) -> PlanT:
    """Return the first of a line of plans of one case that is solved, or else the best; pure.

    Args:
        plan_of: makes the plan at a position () int32 of the line.
        num: () int32, of plans in the line.
        best: the plan that there is already; if it is solved, no other is made.
    """

    def next_one(state: tuple[Array, PlanT]) -> tuple[Array, PlanT]:
        position, best = state
        return position + 1, select(plan_of(position), best)

    def is_open(state: tuple[Array, PlanT]) -> Array:
        position, best = state
        return (position < num) & ~is_solved(best.status)

    return lax.while_loop(is_open, next_one, (jnp.zeros((), jnp.int32), best))[1]
