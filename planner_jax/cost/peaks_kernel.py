"""`greatest_along` on many lanes as one kernel for CUDA.

A thread carries a lane, as in `along_kernel`. It makes the samples one after another and keeps the
excesses of the last two, so that it sees the parabola through every three neighbours.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.arithmetic import reciprocal
from planner_jax.cost.peaks import crest
from planner_jax.lanes.pallas import Block, block_width, kernel_call, place_in_grid
from planner_jax.trajectory.polynomial import Motion

if TYPE_CHECKING:
    from planner_jax.cost.along import Along

_THREADS = 128  # lanes of a block
_ENOUGH = 512  # blocks that keep a large GPU busy


def peaks_kernel(along: "Along", *, interpret: bool = False) -> Callable:
    """The kernel that `lanes.with_kernel` attaches to `greatest_along`.

    Args:
        along: constants.
        interpret: run it without a GPU, for tests.
    """

    def kernel(treedef: Any, leaves: Sequence[Array]) -> list[Array] | None:
        columns, durations, *parameters = leaves
        lanes: Any = durations.shape[-1]
        threads = block_width(lanes, _THREADS)
        # Extras look at the whole position, and rotors at the snap: neither is made here.
        if along.rate is not None or along.orders != 4 or threads is None:
            return None
        if any(leaf.dtype != jnp.float32 for leaf in leaves):
            return None
        if any(leaf.ndim != 1 for leaf in parameters):
            return None
        # `vmap` may have put axes in front of either.
        num_columns = columns.shape[-3]
        lead: Any = jnp.broadcast_shapes(columns.shape[:-3], durations.shape[:-1])
        flat = [
            jnp.broadcast_to(leaf, (*lead, *own, lanes)).reshape(-1, *own, lanes)
            for leaf, own in ((columns, (num_columns, 3)), (durations, ()))
        ]
        call = _call(along, interpret, treedef, (math.prod(lead), num_columns, lanes, threads))
        return [jnp.max(share, axis=0).reshape(*lead, lanes) for share in call(*flat, *parameters)]

    return kernel


@functools.cache
def _call(
    along: "Along", interpret: bool, treedef: Any, sizes: tuple[int, int, int, int]
) -> Callable[..., list[Array]]:
    """The kernel, of the leaves of its arguments, to results with shares of the samples first.

    Args:
        along: constants.
        interpret: run it without a GPU.
        treedef: of the arguments.
        sizes: trajectories of each lane, columns, lanes, and threads of a block.
    """
    trajectories, num_columns, lanes, threads = sizes
    matrices = along.matrices()
    steps = np.diff(along.times())
    num_samples, blocks = len(matrices), lanes // threads
    shares = min(max(_ENOUGH // (trajectories * blocks), 1), 8)
    share = -(-num_samples // shares)
    num = len(along.margins)

    def body(*refs):
        leaves = [_loaded(ref) for ref in refs[: treedef.num_leaves]]
        matrices_ref, steps_ref, *out = refs[treedef.num_leaves :]
        columns, duration, given = jax.tree.unflatten(treedef, leaves)
        begin = place_in_grid(2) * share
        # Of the neighbours' shares one sample on either side, for the parabolas at its ends.
        first = jnp.maximum(begin - 1, 0)
        last = jnp.minimum(begin + share + 1, num_samples)

        def add_sample(k: Array, carry: tuple) -> tuple:
            most, before, middle = carry
            row = [
                [matrices_ref[k, d * num_columns + c] for c in range(num_columns)] for d in range(4)
            ]
            values = _excess(along, row, columns, duration, given)
            gaps = steps_ref[jnp.maximum(k - 2, 0)], steps_ref[jnp.maximum(k - 1, 0)]
            for i, value in enumerate(values):
                rise = crest(before[i], middle[i], value, *gaps)
                peak = jnp.where(k >= first + 2, middle[i] + rise, value)
                most = [*most[:i], jnp.maximum(most[i], jnp.maximum(value, peak)), *most[i + 1 :]]
            return most, middle, list(values)

        none = [jnp.zeros_like(duration)] * num
        least = [jnp.full_like(duration, -jnp.inf)] * num
        most, _, _ = jax.lax.fori_loop(first, last, add_sample, (least, none, none))
        for ref, value in zip(out, most, strict=True):
            ref[...] = value

    def whole(*shape: int) -> Block:
        return shape, lambda *_: (0,) * len(shape)

    inputs: dict[int, Block] = {  # by the axes of an argument's leaf
        1: ((threads,), lambda t, i, s: (i,)),
        2: ((None, threads), lambda t, i, s: (t, i)),
        4: ((None, num_columns, 3, threads), lambda t, i, s: (t, 0, 0, i)),
    }
    result: Any = (
        (shares, trajectories, lanes),
        jnp.float32,
        ((None, None, threads), lambda t, i, s: (s, t, i)),
    )

    def call(*leaves: Array) -> list[Array]:
        kernel = kernel_call(
            body,
            (trajectories, blocks, shares),
            [
                *(inputs[leaf.ndim] for leaf in leaves),
                whole(num_samples, 4 * num_columns),
                whole(num_samples - 1),
            ],
            [result] * num,
            name="greatest_along",
            threads=threads,
            interpret=interpret,
        )
        rows = jnp.asarray(matrices.reshape(num_samples, -1), jnp.float32)
        return kernel(*leaves, rows, jnp.asarray(steps, jnp.float32))

    return call


def _loaded(ref: Any) -> Any:
    """Number of each lane, or C columns of three numbers."""
    if len(ref.shape) != 3:
        return ref[...]
    return [[ref[c, axis] for axis in range(3)] for c in range(ref.shape[0])]


def _excess(
    along: "Along", row: list[list[Array]], columns: list, duration: Array, given: Any
) -> tuple[Array, ...]:
    """Excess over each limit at one sample; of the position the height alone is made."""

    def sampled(order: int, axis: int) -> Array:
        terms = [a * column[axis] for a, column in zip(row[order], columns, strict=True)]
        return functools.reduce(jnp.add, terms)

    rate = reciprocal(duration)
    vel, acc, jerk = (
        tuple(sampled(order, axis) * power for axis in range(3))
        for order, power in ((1, rate), (2, rate * rate), (3, rate * rate * rate))
    )
    parts: Any = {"height": sampled(0, 2), "vel": vel, "acc": acc, "jerk": jerk}
    return along.excess(Motion(**parts), given)
