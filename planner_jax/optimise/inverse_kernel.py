"""A CUDA kernel that inverts one small matrix for each lane, that is, each problem of a batch.

A thread keeps the matrix of its lane in registers. As separate JAX operations, each elimination
step would read and write all entries in memory and wait for the step before it.
"""

import functools
from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jax import Array

from planner_jax.core.compiled import Treedef
from planner_jax.lanes.pallas import block_width, kernel_by_lanes

_THREADS = 32  # threads of a block, one for each matrix
_LARGEST = 12  # greatest number of rows for which a thread keeps all entries in registers


def inverse_kernel(*, interpret: bool = False) -> Callable:
    """Make the CUDA kernel that inverts small matrices; with `interpret` it needs no GPU."""

    def kernel(treedef: Treedef, leaves: Sequence[Array]) -> Sequence[Array] | None:
        (matrix,) = leaves
        width = block_width(matrix.shape[-1], _THREADS)
        if matrix.ndim != 3 or matrix.dtype != jnp.float32 or width is None:
            return None
        if matrix.shape[0] > _LARGEST:
            return None
        return _call(matrix.shape[0], matrix.shape[-1], width, interpret)(matrix)

    return kernel


@functools.cache
def _call(size: int, lanes: int, width: int, interpret: bool) -> Callable:
    def body(matrix, out):
        entries = [[matrix[i, j] for j in range(size)] for i in range(size)]
        least = [1e-6 * jnp.abs(entries[j][j]) + 1e-20 for j in range(size)]
        for j in range(size):
            rate = 1.0 / jnp.maximum(jnp.abs(entries[j][j]), least[j])
            row = [rate if k == j else entries[j][k] * rate for k in range(size)]
            for i in range(size):
                factor = entries[i][j]
                entries[i] = [
                    row[k] if i == j else (0.0 if k == j else entries[i][k]) - factor * row[k]
                    for k in range(size)
                ]
        for i in range(size):
            for j in range(size):
                out[i, j] = entries[i][j]

    shapes = [(size, size)]
    return kernel_by_lanes(
        body, shapes, shapes, lanes, width, name="positive_inverse", interpret=interpret
    )
