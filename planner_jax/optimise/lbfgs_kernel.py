"""A CUDA kernel that computes the next direction of L-BFGS for many problems of a batch.

As separate JAX operations, a direction takes about thirty sums that depend on each other. In the
kernel, a block of threads keeps the gradients of its problems and their pairs of steps and changes
of the gradient in registers. It reads every pair once and overwrites the memory of pairs in place.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import Array, Ref

from planner_jax.core.compiled import Treedef
from planner_jax.lanes.pallas import block_width, kernel_by_lanes, load_masked, store_masked
from planner_jax.optimise.lbfgs import shortening, start_scale, weigh_pair

_LANES, _THREADS = 32, 128  # problems and threads of a CUDA block


def turn_kernel(num_pairs: int, step_cap: float, *, interpret: bool = False) -> Callable:
    """Make the CUDA kernel that updates the memory of L-BFGS and computes the next direction."""

    def kernel(treedef: Treedef, leaves: Sequence[Array]) -> Sequence[Array] | None:
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
    height = 1 << (n - 1).bit_length()  # n rounded up to a power of two, as GPU blocks require

    def body(steps, changes, inverses, step, change, grad, *out):
        new_steps, new_changes, new_inverses, direction = out
        rows = jax.lax.broadcasted_iota(jnp.int32, (height, width), 0)
        columns = jax.lax.broadcasted_iota(jnp.int32, (height, width), 1)
        there = rows < n

        def read(ref: Ref, *pair: int) -> Array:
            return load_masked(ref, (*pair, rows, columns), there)

        def write(ref: Ref, value: Array, *pair: int) -> None:
            store_masked(ref, (*pair, rows, columns), value, there)

        def dot(a: Array, b: Array) -> Array:
            return jnp.sum(a * b, axis=0)

        step, change, grad = read(step), read(change), read(grad)
        keep, moved, inverse = weigh_pair(dot(step, change), dot(change, change), dot(step, step))
        none = jnp.zeros_like(inverse)

        # The loop takes the newest pair (step, change of the gradient) first. If a new pair is
        # stored, pair k + 1 of the memory becomes pair k.
        alphas, kept, q, behind, later = [], [], grad, [step, change], inverse
        for k in reversed(range(num_pairs)):
            old, earlier = [read(steps, k), read(changes, k)], inverses[k]
            own = [
                jnp.where(keep, new, jnp.where(moved, was, 0.0))
                for new, was in zip(behind, old, strict=True)
            ]
            weight = jnp.where(keep, later, jnp.where(moved, earlier, none))
            behind, later = old, earlier
            write(new_steps, own[0], k)
            write(new_changes, own[1], k)
            new_inverses[k] = weight
            alpha = weight * dot(own[0], q)
            q = q - alpha[None] * own[1]
            alphas.append(alpha)
            kept.append((own, weight))
        (_, newest_change), newest = kept[0]
        q = start_scale(newest, dot(newest_change, newest_change), dot(grad, grad))[None] * q
        for ((own_step, own_change), weight), alpha in zip(
            reversed(kept), reversed(alphas), strict=True
        ):
            beta = weight * dot(own_change, q)
            q = q + own_step * (alpha - beta)[None]
        write(direction, -q * shortening(dot(q, q), step_cap)[None])

    memory = [(num_pairs, n), (num_pairs, n), (num_pairs,)]
    vector = (n,)
    return kernel_by_lanes(
        body,
        [*memory, vector, vector, vector],
        [*memory, vector],
        lanes,
        width,
        name="lbfgs_turn",
        threads=_THREADS,
        in_place=3,
        interpret=interpret,
    )
