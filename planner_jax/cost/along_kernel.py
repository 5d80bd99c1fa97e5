"""`integrate_along` on many lanes as one kernel for CUDA.

A thread carries a lane. It reads the columns once, makes the samples one after another, each
from a row of the constant matrices, and adds up penalties and, by the transposed product,
slopes. Memory sees the columns, the results and nothing in between. Where there are few lanes,
several threads share the samples of one.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import Array

from planner_jax.core.arithmetic import reciprocal
from planner_jax.cost.penalty import smoothed_hinge
from planner_jax.lanes.pallas import Block, block_width, kernel_call, place_in_grid
from planner_jax.trajectory.polynomial import Motion

if TYPE_CHECKING:
    from planner_jax.cost.along import Along

_THREADS = 128  # lanes of a block
_ENOUGH = 512  # blocks that keep a large GPU busy
_AXES = ((2,), (0, 1, 2), (0, 1, 2), (0, 1, 2))  # that a motion has of position to jerk
_WORST = 1  # place of the greatest excess among the results

# What is made of the samples: the sum of penalties, and the greatest excess of all; also slopes by
# columns and durations; also those by the parameters; or the derivative of all of these along a
# direction.
MODES = ("values", "slopes", "slopes by all", "curvature")


def along_kernel(along: "Along", mode: str, *, interpret: bool = False) -> Callable:
    """The kernel that `lanes.with_kernel` attaches to one of the functions in `along`.

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
        if along.rate is not None:  # extras take vectors, and the position that is not made here
            return None
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
        sizes = _Sizes(math.prod(lead), num_columns, lanes, threads)
        shares = _call(along, mode, interpret, treedef, sizes)(*jax.tree.leaves(args))
        results = [
            jnp.max(share, axis=0) if k == _WORST else jnp.sum(share, axis=0)
            for k, share in enumerate(shares)
        ]
        return [result.reshape(*lead, *result.shape[1:]) for result in results]

    return kernel


@dataclasses.dataclass(frozen=True)
class _Sizes:
    """Of a kernel for some trajectories of each lane."""

    trajectories: int
    num_columns: int  # C
    lanes: int
    threads: int  # of a block, each of which carries a lane


@functools.cache
def _call(
    along: "Along", mode: str, interpret: bool, treedef: Any, sizes: _Sizes
) -> Callable[..., list[Array]]:
    """The kernel, of the leaves of its arguments, to results with shares of the samples first."""
    matrices, weights = along.matrices(), along.weights()
    num_samples, num_columns = len(weights), sizes.num_columns
    blocks = sizes.lanes // sizes.threads
    shares = min(max(_ENOUGH // (sizes.trajectories * blocks), 1), 8)
    share = -(-num_samples // shares)
    shapes = _result_shapes(mode, treedef, num_columns)
    num_sums = sum(map(math.prod, shapes)) - 1  # all but the greatest excess

    def body(*refs):
        leaves = [_loaded(ref) for ref in refs[: treedef.num_leaves]]
        matrices_ref, weights_ref, *out = refs[treedef.num_leaves :]
        args = jax.tree.unflatten(treedef, leaves)
        duration = leaves[1]

        def add_sample(k: Array, carry: tuple) -> tuple:
            row = [
                [matrices_ref[k, d * num_columns + c] for c in range(num_columns)] for d in range(4)
            ]
            most, sums = carry
            worst, terms = _of_sample(along, mode, _Sample(row, weights_ref[k]), args)
            most = most if worst is None else jnp.maximum(most, worst)
            return most, list(map(jnp.add, sums, jax.tree.leaves(terms)))

        zero = jnp.zeros_like(duration)
        least = zero if mode == "curvature" else jnp.full_like(duration, -jnp.inf)
        first = place_in_grid(2) * share
        last = jnp.minimum(first + share, num_samples)
        start = least, [zero] * num_sums
        most, sums = jax.lax.fori_loop(first, last, add_sample, start)
        _store(out, [*sums[:_WORST], most, *sums[_WORST:]])

    def whole(*shape: int) -> Block:
        return shape, lambda *_: (0,) * len(shape)

    def result(*shape: int) -> tuple[tuple[int, ...], Any, Block]:
        block = (None, None, *shape, sizes.threads)
        place = lambda t, i, s: (s, t, *(0 for _ in shape), i)  # noqa: E731
        return (shares, sizes.trajectories, *shape, sizes.lanes), jnp.float32, (block, place)

    inputs: dict[int, Block] = {  # by the axes of an argument's leaf
        1: ((sizes.threads,), lambda t, i, s: (i,)),
        2: ((None, sizes.threads), lambda t, i, s: (t, i)),
        4: ((None, num_columns, 3, sizes.threads), lambda t, i, s: (t, 0, 0, i)),
    }

    def call(*leaves: Array) -> list[Array]:
        kernel = kernel_call(
            body,
            (sizes.trajectories, blocks, shares),
            [
                *(inputs[leaf.ndim] for leaf in leaves),
                whole(num_samples, 4 * num_columns),
                whole(num_samples),
            ],
            [result(*shape) for shape in shapes],
            name="integrate_along",
            threads=sizes.threads,
            interpret=interpret,
        )
        rows = jnp.asarray(matrices.reshape(num_samples, -1), jnp.float32)
        return kernel(*leaves, rows, jnp.asarray(weights, jnp.float32))

    return call


def _result_shapes(mode: str, treedef: Any, num_columns: int) -> list[tuple[int, ...]]:
    """Shapes of the results for one trajectory of one lane."""
    shapes: list[tuple[int, ...]] = [(), ()]
    if mode != "values":
        shapes += [(num_columns, 3), ()]
    if mode in ("slopes by all", "curvature"):
        args = jax.tree.unflatten(treedef, range(treedef.num_leaves))
        point = args[0] if mode == "curvature" else args
        shapes += [()] * len(jax.tree.leaves(point[2]))
    return shapes


def _loaded(ref: Any) -> Any:
    """Number of each lane, or C columns of three numbers."""
    if len(ref.shape) != 3:
        return ref[...]
    return [[ref[c, axis] for axis in range(3)] for c in range(ref.shape[0])]


def _store(refs: Sequence[Any], values: Iterable[Array]) -> None:
    """Write the results, of which columns come number by number."""
    numbers = iter(values)
    for ref in refs:
        if len(ref.shape) == 3:
            for c in range(ref.shape[0]):
                for axis in range(3):
                    ref[c, axis] = next(numbers)
        else:
            ref[...] = next(numbers)


@dataclasses.dataclass
class _Sample:
    """The constants of one sample."""

    row: list[list[Array]]  # position to jerk, each from C columns
    weight: Array

    def unit_motion(self, columns: list[list[Array]]) -> list[list[Array]]:
        """Position to jerk, in time over the duration; of the position the height alone."""
        return [
            [
                _total(self.row[d][c] * columns[c][axis] for c in range(len(columns)))
                for axis in axes
            ]
            for d, axes in enumerate(_AXES)
        ]

    def slope_by_columns(self, slope: list[list[Array]]) -> list[list[Array]]:
        """What a slope by the unit motion is by the columns."""
        return [
            [
                _total(
                    self.row[d][c] * slope[d][axes.index(axis)]
                    for d, axes in enumerate(_AXES)
                    if axis in axes
                )
                for axis in range(3)
            ]
            for c in range(len(self.row[0]))
        ]


def _total(terms: Iterable) -> Any:
    return functools.reduce(operator.add, terms)


def _of_sample(along: "Along", mode: str, sample: _Sample, args: Any) -> tuple[Any, tuple]:
    """What one sample gives in a mode.

    Returns:
        worst: excess, the greatest of which over the samples is a result; None of a curvature.
        terms: of the sums over the samples, in the order of the results.
    """
    (columns, duration, given), direction = args if mode == "curvature" else (args, ())
    free = sample.unit_motion(columns), duration
    if mode == "values":
        value, worst = _penalty(along, *free, given)
        return worst, (sample.weight * value,)
    if mode == "slopes":
        worst, terms = _slopes(along, sample.weight, free, (given,))
    elif mode == "slopes by all":
        worst, terms = _slopes(along, sample.weight, (*free, given), ())
    else:
        worst, terms = None, _curvature(along, sample, free, given, direction)
    value, by_motion, *others = terms
    return worst, (value, sample.slope_by_columns(by_motion), *others)


def _excess(along: "Along", unit: list, duration: Array, given: Any) -> tuple[Array, ...]:
    """Excess over each limit, of a motion in time over the duration."""
    rate = reciprocal(duration)
    rates = [None, rate, rate * rate, rate * rate * rate]
    vel, acc, jerk = (tuple(value * rates[d] for value in unit[d]) for d in range(1, 4))
    parts: Any = {"height": unit[0][0], "vel": vel, "acc": acc, "jerk": jerk}
    return along.excess(Motion(**parts), given)


def _penalty(along: "Along", unit: list, duration: Array, given: Any) -> tuple[Array, Array]:
    """Sum of hinges times the duration, and the greatest excess of all."""
    excess = _excess(along, unit, duration, given)
    hinges = [
        factor * smoothed_hinge(value + margin, along.hinge_width)
        for value, margin, factor in zip(excess, along.margins, along.hinge_weights, strict=True)
    ]
    return duration * _total(hinges), functools.reduce(jnp.maximum, excess)


def _slopes(along: "Along", weight: Array, free: tuple, fixed: tuple) -> tuple[Array, tuple]:
    """The greatest excess; and the weighted penalty with its slopes by what is free.

    The arguments of `_penalty` are first the free ones, then the fixed ones.
    """
    value, pull_back, worst = jax.vjp(lambda *x: _penalty(along, *x, *fixed), *free, has_aux=True)
    return worst, (weight * value, *pull_back(jnp.ones_like(value) * weight))


def _curvature(
    along: "Along", sample: _Sample, free: tuple, given: Any, direction: tuple
) -> tuple[Any, ...]:
    """Derivative, along a direction, of the weighted penalty and its slopes by all arguments."""
    columns, duration, moved_given = direction
    moving, tangents, still = free, (sample.unit_motion(columns), duration), (given,)
    if moved_given is not None:
        moving, tangents, still = (*free, given), (*tangents, moved_given), ()

    def slopes(*moving: Any) -> tuple:
        return _slopes(along, sample.weight, (*moving, *still), ())[1]

    return jax.jvp(slopes, moving, tangents)[1]
