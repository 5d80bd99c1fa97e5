"""The loop over the cases of a batch in which cases are planned one after another."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import PyTree


def solve_in_turn(solve: Callable[[PyTree], PyTree], cases: PyTree) -> PyTree:
    """Return the results of a function for every case of a batch, one after another; pure.

    A case equal to the one before it, such as the padding of a batch, is not solved again.
    """
    first = jax.tree.map(lambda leaf: leaf[0], cases)
    nothing = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(solve, first)
    )

    def next_one(state: tuple[Array, PyTree, PyTree], case: PyTree) -> tuple[tuple, PyTree]:
        is_first, before, plan = state
        same = jax.tree.map(lambda a, b: jnp.array_equal(a, b), before, case)
        is_again = jnp.all(jnp.stack(jax.tree.leaves(same))) & ~is_first
        plan = lax.cond(is_again, lambda case: plan, solve, case)
        return (jnp.zeros_like(is_first), case, plan), plan

    _, plans = lax.scan(next_one, (jnp.ones((), bool), first, nothing), cases)
    return plans
