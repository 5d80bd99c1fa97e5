"""`integrate_along` and `greatest_along` on many lanes as one kernel for CUDA, in Pallas' Triton.

A thread carries a lane. It reads the columns once, makes the samples one after another, each
from a row of the constant matrices, and adds up penalties and, by the transposed product,
slopes. Memory sees the columns, the results and nothing in between. Where there are few lanes,
several threads share the samples of one.
"""

import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import Array

from planner_jax.arithmetic import reciprocal
from planner_jax.cost.penalty import smoothed_hinge
from planner_jax.lanes import block_width
from planner_jax.trajectory.polynomial import Motion

if TYPE_CHECKING:
    from planner_jax.cost.along import Along

_THREADS = 128  # lanes of a block
_ENOUGH = 512  # blocks that keep a large GPU busy
_AXES = ((2,), (0, 1, 2), (0, 1, 2), (0, 1, 2))  # that a motion has of position to jerk


# What is made of the samples: each limit's greatest excess; the sum of penalties, and the greatest
# excess of all; also slopes by columns and durations; also those by the parameters; or the
# derivative of all of these along a direction.
MODES = ("greatest", "values", "slopes", "slopes by all", "curvature")


def along_kernel(along: "Along", mode: str, *, interpret: bool = False) -> Callable:
    """What `lanes.with_kernel` takes: the lanes' arrays to the lanes' results, or None.

    Args:
        along: constants.
        mode: one of `MODES`. "curvature" takes a point and a direction, of which the parameters'
            part may be None.
        interpret: run it without a GPU, for tests.
    """

    def kernel(treedef: Any, leaves: Sequence[Array]) -> list[Array] | None:
        args = jax.tree.unflatten(treedef, leaves)
        points = args if mode == "curvature" else (args,)
        parameters = jax.tree.leaves([given for *_, given in points])
        shape: Any = leaves[0].shape
        *_, num_columns, _, lanes = shape
        threads = block_width(lanes, _THREADS)
        if any(leaf.dtype != jnp.float32 for leaf in leaves) or threads is None:
            return None
        if any(leaf.ndim != 1 for leaf in parameters):
            return None
        # `vmap` may have put axes in front of a point, or of a direction alone.
        lead: Any = jnp.broadcast_shapes(
            *(columns.shape[:-3] for columns, *_ in points),
            *(durations.shape[:-1] for _, durations, _ in points),
        )

        def flat(leaf: Array, *own: int) -> Array:
            return jnp.broadcast_to(leaf, (*lead, *own, lanes)).reshape(-1, *own, lanes)

        args = [(flat(c, num_columns, 3), flat(h), given) for c, h, given in points]
        args = tuple(args) if mode == "curvature" else args[0]
        sizes = math.prod(lead), num_columns, lanes, threads
        call = _call(along, mode, interpret, treedef, *sizes)
        found = call(*jax.tree.leaves(args))
        found = [
            jnp.max(x, axis=0) if mode == "greatest" or k == _WORST else jnp.sum(x, axis=0)
            for k, x in enumerate(found)
        ]
        return [leaf.reshape(*lead, *leaf.shape[1:]) for leaf in found]

    return kernel


def _total(terms: Iterable) -> Any:
    return functools.reduce(operator.add, terms)


_WORST = 1  # place of the greatest excess among the results


@functools.cache
def _call(
    along: "Along",
    mode: str,
    interpret: bool,
    treedef: Any,
    lead: int,
    num_columns: int,
    lanes: int,
    threads: int,
) -> Callable:
    """The kernel for `lead` trajectories of each of `lanes` lanes."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    matrices, weights = along.matrices(), along.weights()
    num_samples = len(weights)
    blocks = lead * lanes // threads
    shares = min(max(_ENOUGH // blocks, 1), 8)
    share = -(-num_samples // shares)
    num_leaves = treedef.num_leaves
    places = jax.tree.unflatten(treedef, range(num_leaves))
    point = places[0] if mode == "curvature" else places
    by_parameters = len(jax.tree.leaves(point[2])) * (mode in ("slopes by all", "curvature"))
    by_columns = mode not in ("greatest", "values")
    sums_up = mode != "greatest"
    num_greatest = 1 if sums_up else len(along.margins)

    def body(*refs):
        loaded = [
            [[ref[c, axis] for axis in range(3)] for c in range(num_columns)]
            if len(ref.shape) == 3
            else ref[...]
            for ref in refs[:num_leaves]
        ]
        matrices_ref, weights_ref, *out = refs[num_leaves:]
        args = jax.tree.unflatten(treedef, loaded)
        (columns, duration, given), direction = args if mode == "curvature" else (args, args)

        def excess_at(unit: list, duration: Array, given: Any) -> tuple[Array, ...]:
            rate = reciprocal(duration)
            rates = [None, rate, rate * rate, rate * rate * rate]
            vel, acc, jerk = (tuple(value * rates[d] for value in unit[d]) for d in range(1, 4))
            parts: Any = {"height": unit[0][0], "vel": vel, "acc": acc, "jerk": jerk}
            return along.excess(Motion(**parts), given)

        def penalty(unit: list, duration: Array, given: Any) -> tuple[Array, Array]:
            excess = excess_at(unit, duration, given)
            hinges = [
                smoothed_hinge(value + margin, along.hinge_width)
                for value, margin in zip(excess, along.margins, strict=True)
            ]
            return duration * _total(hinges), functools.reduce(jnp.maximum, excess)

        def sample(k: Array, carry: tuple) -> tuple:
            most, sums = carry
            row = [
                [matrices_ref[k, d * num_columns + c] for c in range(num_columns)] for d in range(4)
            ]
            weight = weights_ref[k]

            def unit_of(columns: list) -> list:
                return [
                    [
                        _total(row[d][c] * columns[c][axis] for c in range(num_columns))
                        for axis in axes
                    ]
                    for d, axes in enumerate(_AXES)
                ]

            def slopes(*free: Any, fixed: tuple = ()) -> tuple:
                moving: Any = lambda *free: penalty(*free, *fixed)  # noqa: E731
                value, pull_back, greatest = jax.vjp(moving, *free, has_aux=True)
                return greatest, weight * value, *pull_back(jnp.ones_like(value) * weight)

            free = (unit_of(columns), duration)
            greatest, found = most, ()
            if mode == "greatest":
                greatest = list(map(jnp.maximum, most, excess_at(*free, given)))
            elif mode == "values":
                value, worst = penalty(*free, given)
                greatest, found = [jnp.maximum(most[0], worst)], (weight * value,)
            elif mode == "slopes":
                worst, *found = slopes(*free, fixed=(given,))
                greatest = [jnp.maximum(most[0], worst)]
            elif mode == "slopes by all":
                worst, *found = slopes(*free, given)
                greatest = [jnp.maximum(most[0], worst)]
            else:
                along_columns, along_duration, along_given = direction
                tangents = (unit_of(along_columns), along_duration)
                if along_given is None:
                    moving: Any = lambda *free: slopes(*free, given)  # noqa: E731
                else:
                    moving, free, tangents = slopes, (*free, given), (*tangents, along_given)
                _, (_, *found) = jax.jvp(moving, free, tangents)
            if len(found) > 1:
                found[1] = [
                    [
                        _total(
                            row[d][c] * found[1][d][axes.index(axis)]
                            for d, axes in enumerate(_AXES)
                            if axis in axes
                        )
                        for axis in range(3)
                    ]
                    for c in range(num_columns)
                ]
            return greatest, list(map(jnp.add, sums, jax.tree.leaves(found)))

        zero = jnp.zeros_like(duration)
        worst = zero if mode == "curvature" else jnp.full_like(duration, -jnp.inf)
        first = pl.program_id(2) * share
        last = jnp.minimum(first + share, num_samples)
        num_sums = 1 + by_columns * (3 * num_columns + 1) + by_parameters if sums_up else 0
        start = [worst] * num_greatest, [zero] * num_sums
        most, sums = jax.lax.fori_loop(first, last, sample, start)
        found = iter([*sums[:_WORST], *most, *sums[_WORST:]])
        for ref in out:
            if len(ref.shape) == 3:
                for c in range(num_columns):
                    for axis in range(3):
                        ref[c, axis] = next(found)
            else:
                ref[...] = next(found)

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

    def call(*leaves: Array) -> list[Array]:
        specs = {1: shared, 2: one, 4: many}
        return pl.pallas_call(
            body,
            out_shape=[
                *((number,) * (sums_up + num_greatest)),
                *((vector, number) if by_columns else ()),
                *((number,) * by_parameters),
            ],
            grid=(lead, lanes // threads, shares),
            in_specs=[
                *(specs[leaf.ndim] for leaf in leaves),
                whole(num_samples, 4 * num_columns),
                whole(num_samples),
            ],
            out_specs=[
                *((one_out,) * (sums_up + num_greatest)),
                *((many_out, one_out) if by_columns else ()),
                *((one_out,) * by_parameters),
            ],
            compiler_params=triton.CompilerParams(num_warps=max(threads // 32, 1), num_stages=1),
            interpret=interpret,
            name="integrate_along",
        )(
            *leaves,
            jnp.asarray(matrices.reshape(num_samples, -1), jnp.float32),
            jnp.asarray(weights, jnp.float32),
        )

    return call
