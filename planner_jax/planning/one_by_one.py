"""Cases planned one after another, as suits a CPU where they differ in how long they take."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend.backend import backends

CaseT = TypeVar("CaseT")
PlanT = TypeVar("PlanT")


def suited(
    solve: Callable[[CaseT], PlanT],
    cases: CaseT,
    at_once: Callable[[CaseT], PlanT] | None = None,
) -> PlanT:
    """The plans of a batch as suits the device: on a CPU one after another, else all at once; pure.

    Where there is nothing but a CPU, what is for others is not even traced, which takes longer.

    Args:
        solve: the plan of one case.
        cases: leaves with a leading axis.
        at_once: the plans of the batch; by default `solve` of all cases in step.
    """
    if has_only_cpu():
        return one_by_one(solve, cases)
    return lax.platform_dependent(
        cases,
        cpu=lambda cases: one_by_one(solve, cases),
        default=at_once or jax.vmap(solve),
    )


def has_only_cpu() -> bool:
    """Whether all devices that JAX has are CPUs."""
    return set(backends()) == {"cpu"}


def one_by_one(solve: Callable[[CaseT], PlanT], cases: CaseT) -> PlanT:
    """What a function makes of every case, leaves with a leading axis; pure.

    A case that is the one before once more, as those that fill up a batch are, is not solved anew.
    """
    first = jax.tree.map(lambda leaf: leaf[0], cases)
    nothing = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(solve, first)
    )

    def next_one(state: tuple[Array, CaseT, PlanT], case: CaseT) -> tuple[tuple, PlanT]:
        is_first, before, plan = state
        same = jax.tree.map(lambda a, b: jnp.array_equal(a, b), before, case)
        is_again = jnp.all(jnp.stack(jax.tree.leaves(same))) & ~is_first
        plan = lax.cond(is_again, lambda case: plan, solve, case)
        return (jnp.zeros_like(is_first), case, plan), plan

    _, plans = lax.scan(next_one, (jnp.ones((), bool), first, nothing), cases)
    return plans
