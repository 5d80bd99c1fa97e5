"""Preconditioners for Newton's method: inverses of dense blocks and of a diagonal."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.lanes import with_kernel
from planner_jax.optimise.settings import Preconditioner


def block_preconditioner(blocks: np.ndarray, within: Array, others: Array) -> Preconditioner:
    """Return a preconditioner that inverts dense blocks, and a diagonal for other variables.

    `blocks` are indices (K, k) of K blocks of k coupled variables, and `within` the second
    derivatives (K, k, k) among them. `others` is the diagonal (n,) of the Hessian of n variables;
    its entries for the blocks are ignored. The result is a function of a damping (), which is added
    to the diagonal. It returns the function that multiplies a vector by the inverse. For a block
    that is not positive definite, the pivots of the inversion are made positive.
    """
    size, num = others.shape[0], blocks.shape[1]
    inside = np.zeros(size, bool)
    inside[blocks.ravel()] = True
    sizes = jnp.abs(others)
    largest = jnp.max(jnp.where(inside, 0.0, sizes))

    def factorise(damping: Array) -> Callable[[Array], Array]:
        of_others = jnp.maximum(sizes, 1e-6 * largest + 1e-20) + damping
        unit = jnp.asarray(np.eye(num), others.dtype)
        inverses = [positive_inverse(block + damping * unit) for block in within]

        def solve(right: Array) -> Array:
            entries, found = tuple(right), list(right / of_others)
            for block, inverse in zip(blocks, inverses, strict=True):
                part = jnp.stack([entries[j] for j in block])
                solved = jnp.sum(inverse * part[None], axis=1)
                for place, value in zip(block, tuple(solved), strict=True):
                    found[place] = value
            return jnp.stack(found)

        return solve

    return factorise


def _gauss_jordan(matrix: Array) -> Array:
    """Return the inverse of a symmetric matrix (k, k) by Gauss-Jordan elimination.

    The rows are not exchanged. Pivots are replaced by their absolute values, or by a small positive
    number. For a positive definite matrix no pivot changes, and the inverse is exact.
    """
    size = matrix.shape[0]
    least = 1e-6 * jnp.abs(jnp.diagonal(matrix)) + 1e-20

    def eliminate(j: Array, m: Array) -> Array:
        here = jnp.arange(size) == j
        row = jnp.sum(jnp.where(here[:, None], m, 0.0), axis=0)
        column = jnp.sum(jnp.where(here, m, 0.0), axis=1)
        pivot = jnp.maximum(
            jnp.abs(jnp.sum(jnp.where(here, row, 0.0))), jnp.sum(jnp.where(here, least, 0.0))
        )
        scaled = jnp.where(here, 1.0, row) / pivot
        rest = jnp.where(here, 0.0, m)
        return jnp.where(here[:, None], scaled, rest - column[:, None] * scaled[None])

    return jax.lax.fori_loop(0, size, eliminate, matrix)


positive_inverse = with_kernel(_gauss_jordan, "planner_jax.optimise.inverse_kernel:inverse_kernel")
