"""Cases planned one after another, as suits a CPU where they differ in how long they take."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend.backend import backends

CaseT = TypeVar("CaseT")
PlanT = TypeVar("PlanT")


class OneByOne:
    """A planner whose batches a CPU plans one case after another, and others all at once.

    For planners of which a case may take many times as long as another: in step, all would wait
    for it. A batch of which a CPU's cores plan a part each is cut into small ones.
    """

    def solve(self, case: Any, attempt: Any) -> Any:
        """The plan of one case."""
        raise NotImplementedError

    def solve_lanes(self, cases: Any, attempt: Any) -> Any:
        """The plans of a batch: on a CPU one after another, else all at once; pure."""
        in_turn = functools.partial(one_by_one, lambda case: self.solve(case, attempt))
        # Where there is nothing but a CPU, what is for others is not traced, which takes longer.
        if has_only_cpu():
            return in_turn(cases)
        return lax.platform_dependent(
            cases,
            cpu=in_turn,
            default=lambda cases: self.solve_at_once(cases, attempt),
        )

    def solve_at_once(self, cases: Any, attempt: Any) -> Any:
        """The plans of a batch, all in step."""
        return jax.vmap(lambda case: self.solve(case, attempt))(cases)


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
