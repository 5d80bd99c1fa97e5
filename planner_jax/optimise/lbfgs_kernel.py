"""The next direction of L-BFGS on many lanes as one kernel for CUDA, in Pallas' Triton.

In single operations it is a chain of some thirty sums that each wait for the last. Here a block
of threads keeps its lanes' gradient and pairs in registers; it reads every pair once and writes
it where the memory has been, so that nothing is copied between iterations.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from planner_jax.lanes import block_width

_LANES = 32  # of a block


def turn_kernel(num_pairs: int, step_cap: float, *, interpret: bool = False) -> Callable:
    """What `lanes.with_kernel` takes for `lbfgs.remember` and `lbfgs.search_direction`.

    Args:
        num_pairs: m.
        step_cap: largest length of the direction.
        interpret: run it without a GPU, for tests.
    """

    def kernel(treedef: Any, leaves: Sequence[Array]) -> list[Array] | None:
        grad = leaves[-1]
        width = block_width(grad.shape[-1], _LANES)
        if grad.ndim != 2 or grad.dtype != jnp.float32 or width is None:
            return None
        return _call(num_pairs, step_cap, *grad.shape, width, interpret)(*leaves)

    return kernel


@functools.cache
def _call(
    num_pairs: int, step_cap: float, n: int, lanes: int, width: int, interpret: bool
) -> Callable:
    """The kernel for vectors of n on `lanes` lanes."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    height = 1 << (n - 1).bit_length()  # a block's rows are a power of two

    def body(steps, changes, inverses, step, change, grad, *out):
        new_steps, new_changes, new_inverses, direction = out
        rows = jax.lax.broadcasted_iota(jnp.int32, (height, width), 0)
        columns = jax.lax.broadcasted_iota(jnp.int32, (height, width), 1)
        there = rows < n

        def load(ref: Any, *pair: int) -> Array:
            return triton.load(ref.at[(*pair, rows, columns)], mask=there, other=0.0)

        def store(ref: Any, value: Array, *pair: int) -> None:
            triton.store(ref.at[(*pair, rows, columns)], value, mask=there)

        def dot(a: Array, b: Array) -> Array:
            return jnp.sum(a * b, axis=0)

        step, change, grad = load(step), load(change), load(grad)
        curvature = dot(step, change)
        keep = curvature > 1e-8 * dot(change, change)
        moved = dot(step, step) > 0.0
        inverse = jnp.where(keep, 1.0 / jnp.where(keep, curvature, 1.0), 0.0)
        none = jnp.zeros_like(inverse)

        # Newest first. A slot's pair is the one behind it if there is a new one.
        alphas, kept, q, behind, later = [], [], grad, [step, change], inverse
        for k in reversed(range(num_pairs)):
            old, earlier = [load(steps, k), load(changes, k)], inverses[k]
            own = [
                jnp.where(keep, new, jnp.where(moved, was, 0.0))
                for new, was in zip(behind, old, strict=True)
            ]
            weight = jnp.where(keep, later, jnp.where(moved, earlier, none))
            behind, later = old, earlier
            store(new_steps, own[0], k)
            store(new_changes, own[1], k)
            new_inverses[k] = weight
            alpha = weight * dot(own[0], q)
            q = q - alpha * own[1]
            alphas.append(alpha)
            kept.append((own, weight))
        (_, newest_change), newest = kept[0]
        size = dot(newest_change, newest_change) * newest
        slope = jnp.sqrt(jnp.maximum(dot(grad, grad), 1e-30))
        gamma = jnp.where(newest > 0.0, 1.0 / jnp.where(newest > 0.0, size, 1.0), 1.0 / slope)
        q = gamma * q
        for ((own_step, own_change), weight), alpha in zip(
            reversed(kept), reversed(alphas), strict=True
        ):
            beta = weight * dot(own_change, q)
            q = q + own_step * (alpha - beta)
        length = jnp.sqrt(jnp.maximum(dot(q, q), 1e-30))
        store(direction, -q * jnp.minimum(1.0, step_cap / length))

    matrix = pl.BlockSpec((num_pairs, n, width), lambda i: (0, 0, i))
    vector = pl.BlockSpec((n, width), lambda i: (0, i))
    numbers = pl.BlockSpec((num_pairs, width), lambda i: (0, i))
    return pl.pallas_call(
        body,
        out_shape=[
            jax.ShapeDtypeStruct((num_pairs, n, lanes), jnp.float32),
            jax.ShapeDtypeStruct((num_pairs, n, lanes), jnp.float32),
            jax.ShapeDtypeStruct((num_pairs, lanes), jnp.float32),
            jax.ShapeDtypeStruct((n, lanes), jnp.float32),
        ],
        grid=(lanes // width,),
        in_specs=[matrix, matrix, numbers, vector, vector, vector],
        out_specs=[matrix, matrix, numbers, vector],
        input_output_aliases={0: 0, 1: 1, 2: 2},
        compiler_params=triton.CompilerParams(num_warps=4, num_stages=1),
        interpret=interpret,
        name="lbfgs_turn",
    )
