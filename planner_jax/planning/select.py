"""Plans in whose place others come where these do better."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.core.protocol import Plan, is_solved

PlanT = TypeVar("PlanT", bound=Plan)


def _better(later: Any, plans: Any) -> Any:
    """Where a later attempt did better."""
    return is_solved(later.status) | (later.violation < plans.violation)


def better_of(plans: Any, later: Any, where: Array) -> Any:
    """The plans, with later ones where these do better among the cases that `where` tells."""
    chosen = where & _better(later, plans)

    def pick(old: Array, new: Array) -> Array:
        return jnp.where(chosen.reshape(chosen.shape + (1,) * (new.ndim - chosen.ndim)), new, old)

    return jax.tree.map(pick, plans, later)


def first_solved(plan_of: Callable[[Array], PlanT], num: Array | int, best: PlanT) -> PlanT:
    """The first of a line of plans of one case that is solved, or the best where none is.

    Args:
        plan_of: makes the plan at a place () int32 of the line.
        num: () int32, of plans in the line.
        best: what there is already; if it is solved, nothing is made.
    """

    def next_one(state: tuple[Array, PlanT]) -> tuple[Array, PlanT]:
        place, best = state
        return place + 1, better_of(best, plan_of(place), jnp.asarray(True))

    def is_open(state: tuple[Array, PlanT]) -> Array:
        place, best = state
        return (place < num) & ~is_solved(best.status)

    return lax.while_loop(is_open, next_one, (jnp.zeros((), jnp.int32), best))[1]


def merged(plans: Any, later: Any, lanes: np.ndarray) -> Any:
    """The plans, in place, with those of some lanes replaced by later ones that are better."""
    later = jax.tree.map(lambda leaf: np.asarray(leaf)[: lanes.size], later)
    better = _better(later, jax.tree.map(lambda leaf: leaf[lanes], plans))

    def replace(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        old[lanes[better]] = new[better]
        return old

    return jax.tree.map(replace, plans, later)
