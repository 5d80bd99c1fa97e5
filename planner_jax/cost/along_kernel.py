"""`integrate_along` on many lanes as one kernel for CUDA, in Pallas' Triton.

A thread carries a lane. It reads the columns once, makes the samples one after another, each
from a row of the constant matrices, and adds up penalties and, by the transposed product,
slopes. Memory sees the columns, the results and nothing in between. Where there are few lanes,
several threads share the samples of one.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import Array

from planner_jax.cost.penalty import smoothed_hinge
from planner_jax.trajectory.polynomial import Motion

if TYPE_CHECKING:
    from planner_jax.cost.along import Along

_THREADS = 128  # lanes of a block
_ENOUGH = 512  # blocks that keep a large GPU busy
_FEWEST = 16  # lanes that are worth a block


def along_kernel(along: "Along", *, slopes: bool, interpret: bool = False) -> Callable:
    """What `lanes.with_kernel` takes: the lanes' arrays to the lanes' results, or None.

    Args:
        along: constants.
        slopes: whether slopes by columns and durations are results too.
        interpret: run it without a GPU, for tests.
    """

    def kernel(treedef: Any, leaves: Sequence[Array]) -> list[Array] | None:
        columns, durations, *parameters = leaves
        *lead, num_columns, _, lanes = columns.shape
        threads = math.gcd(lanes, _THREADS)
        flat = all(leaf.ndim == 1 for leaf in parameters)
        if columns.dtype != jnp.float32 or durations.ndim != len(lead) + 1:
            return None
        if not flat or threads < _FEWEST:
            return None
        call = _call(along, slopes, interpret, treedef, math.prod(lead), num_columns, lanes)
        columns = columns.reshape(-1, num_columns, 3, lanes)
        found = call(columns, durations.reshape(-1, lanes), *parameters)
        combine = [jnp.sum, jnp.max, jnp.sum, jnp.sum]
        found = [together(leaf, axis=0) for together, leaf in zip(combine, found, strict=False)]
        return [leaf.reshape(*lead, *leaf.shape[1:]) for leaf in found]

    return kernel


@functools.cache
def _call(
    along: "Along",
    slopes: bool,
    interpret: bool,
    treedef: Any,
    lead: int,
    num_columns: int,
    lanes: int,
) -> Callable:
    """The kernel for `lead` trajectories of each of `lanes` lanes."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    threads = math.gcd(lanes, _THREADS)
    matrices, weights = along.matrices(), along.weights()
    num_samples = len(weights)
    blocks = lead * lanes // threads
    shares = min(max(_ENOUGH // blocks, 1), 8)
    share = -(-num_samples // shares)

    def body(columns_ref, durations_ref, *refs):
        num_parameters = len(refs) - 2 - (4 if slopes else 2)
        parameters = [ref[...] for ref in refs[:num_parameters]]
        matrices_ref, weights_ref, *out = refs[num_parameters:]
        # The tree is that of (columns, durations, parameters).
        _, _, given = jax.tree.unflatten(treedef, [None, None, *parameters])
        columns = [[columns_ref[c, axis] for axis in range(3)] for c in range(num_columns)]
        duration = durations_ref[...]
        rate = 1.0 / duration
        rates = [jnp.ones_like(rate), rate, rate * rate, rate * rate * rate]

        def penalty(motion: Motion) -> tuple[Array, Array]:
            excess = along.excess(motion, given)
            hinges = [
                smoothed_hinge(value + margin, along.hinge_width)
                for value, margin in zip(excess, along.margins, strict=True)
            ]
            return sum(hinges[1:], hinges[0]), functools.reduce(jnp.maximum, excess)

        def sample(k: Array, carry: tuple) -> tuple:
            total, worst, of_columns, of_rate = carry
            row = [
                [matrices_ref[k, d * num_columns + c] for c in range(num_columns)] for d in range(4)
            ]
            unit = [
                [sum(row[d][c] * columns[c][axis] for c in range(num_columns)) for axis in axes]
                for d, axes in enumerate(((2,), (0, 1, 2), (0, 1, 2), (0, 1, 2)))
            ]
            pos, vel, acc, jerk = (tuple(value * rates[d] for value in unit[d]) for d in range(4))
            parts: Any = {"height": pos[0], "vel": vel, "acc": acc, "jerk": jerk}
            motion = Motion(**parts)
            weight = weights_ref[k]
            if not slopes:
                value, greatest = penalty(motion)
                return total + weight * value, jnp.maximum(worst, greatest), of_columns, of_rate
            value, pull_back, greatest = jax.vjp(penalty, motion, has_aux=True)
            (slope,) = pull_back(jnp.ones_like(duration) * weight)
            by_order = ((slope.height,), slope.vel, slope.acc, slope.jerk)
            for d in range(1, 4):
                moved = sum(u * s for u, s in zip(unit[d], by_order[d], strict=True))
                of_rate = of_rate + float(d) * rates[d - 1] * moved
            scaled = [[value * rates[d] for value in by_order[d]] for d in range(4)]
            of_columns = [
                [
                    of_columns[c][axis]
                    + sum(row[d][c] * scaled[d][axis] for d in range(1, 4))
                    + (row[0][c] * scaled[0][0] if axis == 2 else 0.0)
                    for axis in range(3)
                ]
                for c in range(num_columns)
            ]
            return total + weight * value, jnp.maximum(worst, greatest), of_columns, of_rate

        zero = jnp.zeros_like(duration)
        none = [[zero] * 3 for _ in range(num_columns)] if slopes else []
        begin = (zero, jnp.full_like(duration, -jnp.inf), none, zero)
        first = pl.program_id(2) * share
        last = jnp.minimum(first + share, num_samples)
        total, worst, of_columns, of_rate = jax.lax.fori_loop(first, last, sample, begin)
        out[0][...] = duration * total
        out[1][...] = worst
        for c, axes in enumerate(of_columns):
            for axis, value in enumerate(axes):
                out[2][c, axis] = duration * value
        if slopes:
            out[3][...] = total - duration * rate * rate * of_rate

    def whole(*shape: int) -> pl.BlockSpec:
        return pl.BlockSpec(shape, lambda *_: (0,) * len(shape))

    one = pl.BlockSpec((None, threads), lambda t, i, s: (t, i))
    many = pl.BlockSpec((None, num_columns, 3, threads), lambda t, i, s: (t, 0, 0, i))
    shared = pl.BlockSpec((threads,), lambda t, i, s: (i,))
    # Results have the shares of the samples in front.
    one_out = pl.BlockSpec((None, None, threads), lambda t, i, s: (s, t, i))
    many_out = pl.BlockSpec((None, None, num_columns, 3, threads), lambda t, i, s: (s, t, 0, 0, i))
    number = jax.ShapeDtypeStruct((shares, lead, lanes), jnp.float32)
    vector = jax.ShapeDtypeStruct((shares, lead, num_columns, 3, lanes), jnp.float32)

    def call(columns: Array, durations: Array, *parameters: Array) -> list[Array]:
        return pl.pallas_call(
            body,
            out_shape=[number, number, *((vector, number) if slopes else ())],
            grid=(lead, lanes // threads, shares),
            in_specs=[
                many,
                one,
                *(shared for _ in parameters),
                whole(num_samples, 4 * num_columns),
                whole(num_samples),
            ],
            out_specs=[one_out, one_out, *((many_out, one_out) if slopes else ())],
            compiler_params=triton.CompilerParams(num_warps=max(threads // 32, 1), num_stages=1),
            interpret=interpret,
            name="integrate_along",
        )(
            columns,
            durations,
            *parameters,
            jnp.asarray(matrices.reshape(num_samples, -1), jnp.float32),
            jnp.asarray(weights, jnp.float32),
        )

    return call
