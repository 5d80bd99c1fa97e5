"""A CUDA kernel for `integrate_along`: penalties along the trajectories of many lanes (problems).

One thread computes one lane: it reads the columns (scaled end states and waypoint offsets) of a
segment, computes its samples one after another, and sums the penalties and their derivatives. If
there are few lanes, several threads divide the samples of one lane among them.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, Ref
from jaxtyping import PyTree

from planner_jax.core.arithmetic import reciprocal
from planner_jax.core.compiled import Treedef
from planner_jax.cost.along import Along
from planner_jax.cost.penalty import smooth_hinge
from planner_jax.lanes.pallas import Block, block_width, grid_index, kernel_call
from planner_jax.trajectory.polynomial import Motion

_THREADS = 128  # threads of a block, one for each lane
_ENOUGH = 512  # number of blocks that keeps a large GPU busy
# Axes (0, 1, 2: x, y, z) of position, velocity, acceleration and jerk on which limits depend.
_AXES = ((2,), (0, 1, 2), (0, 1, 2), (0, 1, 2))
_WORST = 1  # index of the greatest excess among the results of a kernel

# Results of a kernel: "values" are the sum of penalties and the greatest excess over a limit;
# "slopes" adds derivatives by columns (end states, waypoint offsets) and durations, "slopes by all"
# also by the limits; "curvature" is the derivative of all these along a direction.
MODES = ("values", "slopes", "slopes by all", "curvature")

Vectors = list[list[Array]]  # columns, or derivatives of a motion, each with its components


@dataclasses.dataclass(frozen=True)
class Grid:
    """Division of a kernel's work into GPU blocks by segments and lanes (problems of a batch)."""

    trajectories: int  # number of segments of each lane
    num_columns: int  # number of columns (boundary rows and waypoint offsets) of a segment
    lanes: int
    threads: int  # number of threads of a block, one for each lane

    @property
    def blocks(self) -> int:
        """Number of GPU blocks for one segment of all lanes (problems of the batch)."""
        return self.lanes // self.threads

    @property
    def shares(self) -> int:
        """Number of GPU threads, 1 to 8, for one trajectory's samples; more for small batches."""
        return min(max(_ENOUGH // (self.trajectories * self.blocks), 1), 8)

    def flatten(self, leaf: Array, lead: tuple[int, ...], *own: int) -> Array:
        """Broadcast an array to (*lead, *own, lanes), and join all axes `lead` into one axis."""
        return jnp.broadcast_to(leaf, (*lead, *own, self.lanes)).reshape(-1, *own, self.lanes)


def grid_of(
    along: Along, leaves: Sequence[Array], points: Sequence[tuple[Array, Array, PyTree]]
) -> tuple[Grid, tuple[int, ...]] | None:
    """Return the GPU grid for a kernel's arguments, and the leading axes that `vmap` added to them.

    `points` has (columns, durations, parameters); the mode "curvature" adds a second tuple, their
    tangents. `leaves` are all arrays in `points`. None: the kernel does not support the arguments.
    """
    *_, num_columns, _, lanes = points[0][0].shape
    threads = block_width(lanes, _THREADS)
    # The kernel computes no horizontal position, which the user's cost terms (`rate`) need, and no
    # snap, which limits of single rotors need (5 orders).
    if along.rate is not None or along.orders != 4 or threads is None:
        return None
    if any(leaf.dtype != jnp.float32 for leaf in leaves):
        return None
    if any(leaf.ndim != 1 for *_, given in points for leaf in jax.tree.leaves(given)):
        return None
    lead = jnp.broadcast_shapes(
        *(columns.shape[:-3] for columns, *_ in points),
        *(durations.shape[:-1] for _, durations, _ in points),
    )
    return Grid(math.prod(lead), num_columns, lanes, threads), lead


def call_on_grid(
    body: Callable[..., None],
    grid: Grid,
    shapes: Sequence[tuple[int, ...]],
    constants: Sequence[np.ndarray],
    *,
    name: str,
    interpret: bool,
) -> Callable[..., Sequence[Array]]:
    """Make a function that runs a kernel, whose threads each process a part of the samples.

    The results have a first axis over these parts. `body` takes references to the arguments, to the
    `constants`, which every block reads, and to the results. `shapes` are the results' shapes for
    one segment of one lane (problem of the batch).
    """

    def whole(shape: tuple[int, ...]) -> Block:
        return shape, lambda *_: (0,) * len(shape)

    def result(shape: tuple[int, ...]) -> tuple[tuple[int, ...], type, Block]:
        block = (None, None, *shape, grid.threads)
        index = lambda t, i, s: (s, t, *(0 for _ in shape), i)  # noqa: E731
        return (grid.shares, grid.trajectories, *shape, grid.lanes), jnp.float32, (block, index)

    inputs: dict[int, Block] = {  # blocks of the leaves, by their number of axes
        1: ((grid.threads,), lambda t, i, s: (i,)),
        2: ((None, grid.threads), lambda t, i, s: (t, i)),
        4: ((None, grid.num_columns, 3, grid.threads), lambda t, i, s: (t, 0, 0, i)),
    }

    def call(*leaves: Array) -> Sequence[Array]:
        kernel = kernel_call(
            body,
            (grid.trajectories, grid.blocks, grid.shares),
            [*(inputs[leaf.ndim] for leaf in leaves), *(whole(x.shape) for x in constants)],
            [result(shape) for shape in shapes],
            name=name,
            threads=grid.threads,
            interpret=interpret,
        )
        return kernel(*leaves, *(jnp.asarray(x, jnp.float32) for x in constants))

    return call


def along_kernel(
    along: Along, mode: str, *, interpret: bool = False
) -> Callable[[Treedef, Sequence[Array]], Sequence[Array] | None]:
    """Make the CUDA kernel that computes penalties along trajectories; `interpret` needs no GPU.

    The `mode` "values" returns penalties and greatest excesses, "slopes" also derivatives by
    columns (end states, waypoint offsets) and durations, "slopes by all" by the limits, too.
    "curvature" returns derivatives of all these results along a direction, None for fixed limits.
    """

    def kernel(treedef: Treedef, leaves: Sequence[Array]) -> Sequence[Array] | None:
        args = jax.tree.unflatten(treedef, leaves)
        points = args if mode == "curvature" else (args,)
        found = grid_of(along, leaves, points)
        if found is None:
            return None
        grid, lead = found
        flat = tuple(
            (grid.flatten(c, lead, grid.num_columns, 3), grid.flatten(h, lead), given)
            for c, h, given in points
        )
        shares = _call(along, mode, interpret, treedef, grid)(*jax.tree.leaves(flat))
        results = [
            jnp.max(share, axis=0) if k == _WORST else jnp.sum(share, axis=0)
            for k, share in enumerate(shares)
        ]
        return [result.reshape(*lead, *result.shape[1:]) for result in results]

    return kernel


@functools.cache
def _call(
    along: Along, mode: str, interpret: bool, treedef: Treedef, grid: Grid
) -> Callable[..., Sequence[Array]]:
    matrices, weights = along.matrices(), along.weights()
    num_samples = len(weights)
    share = -(-num_samples // grid.shares)
    shapes = _result_shapes(mode, treedef, grid.num_columns)
    num_sums = sum(map(math.prod, shapes)) - 1  # all but the greatest excess

    def body(*refs: Ref) -> None:
        leaves = [load_numbers(ref) for ref in refs[: treedef.num_leaves]]
        matrices_ref, weights_ref, *out = refs[treedef.num_leaves :]
        args = jax.tree.unflatten(treedef, leaves)
        duration = leaves[1]

        def add_sample(k: Array, carry: tuple[Array, list[Array]]) -> tuple[Array, list[Array]]:
            most, sums = carry
            sample = _Sample(load_row(matrices_ref, k, grid.num_columns), weights_ref[k])
            worst, terms = _of_sample(along, mode, sample, args)
            most = most if worst is None else jnp.maximum(most, worst)
            return most, list(map(jnp.add, sums, jax.tree.leaves(terms)))

        zero = jnp.zeros_like(duration)
        least = zero if mode == "curvature" else jnp.full_like(duration, -jnp.inf)
        first = grid_index(2) * share
        last = jnp.minimum(first + share, num_samples)
        most, sums = jax.lax.fori_loop(first, last, add_sample, (least, [zero] * num_sums))
        _store(out, [*sums[:_WORST], most, *sums[_WORST:]])

    constants = matrices.reshape(num_samples, -1), weights
    return call_on_grid(body, grid, shapes, constants, name="integrate_along", interpret=interpret)


def _result_shapes(mode: str, treedef: Treedef, num_columns: int) -> list[tuple[int, ...]]:
    shapes: list[tuple[int, ...]] = [(), ()]
    if mode != "values":
        shapes += [(num_columns, 3), ()]
    if mode in ("slopes by all", "curvature"):
        args = jax.tree.unflatten(treedef, range(treedef.num_leaves))
        point = args[0] if mode == "curvature" else args
        shapes += [()] * len(jax.tree.leaves(point[2]))
    return shapes


def load_numbers(ref: Ref) -> PyTree:
    """Load numbers of all lanes (problems): one number each, or C vectors from (C, 3, lanes)."""
    if len(ref.shape) != 3:
        return ref[...]
    return [[ref[c, axis] for axis in range(3)] for c in range(ref.shape[0])]


def load_row(matrices: Ref, sample: Array, num_columns: int) -> Vectors:
    """Load a sample's matrix (4, C) from end states and waypoint offsets to position, ..., jerk."""
    return [[matrices[sample, d * num_columns + c] for c in range(num_columns)] for d in range(4)]


def _store(refs: Sequence[Ref], values: Iterable[Array]) -> None:
    numbers = iter(values)
    for ref in refs:
        if len(ref.shape) == 3:
            for c in range(ref.shape[0]):
                for axis in range(3):
                    ref[c, axis] = next(numbers)
        else:
            ref[...] = next(numbers)


def unit_motion(row: Vectors, columns: Vectors) -> Vectors:
    """Return a sample's height, velocity, acceleration and jerk for a mean piece duration of 1 s.

    The matrix `row` (4, C) multiplies C `columns`, which are end states and waypoint offsets.
    """
    return [
        [_total(row[d][c] * columns[c][axis] for c in range(len(columns))) for axis in axes]
        for d, axes in enumerate(_AXES)
    ]


@dataclasses.dataclass
class _Sample:
    row: Vectors  # factors of the C columns, for position, velocity, acceleration and jerk
    weight: Array

    def slope_by_columns(self, slope: Vectors) -> Vectors:
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


def _total(terms: Iterable[Array]) -> Array:
    return functools.reduce(operator.add, terms)


def _of_sample(
    along: Along, mode: str, sample: _Sample, args: PyTree
) -> tuple[Array | None, tuple]:
    (columns, duration, given), direction = args if mode == "curvature" else (args, ())
    free = unit_motion(sample.row, columns), duration
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


def sample_excess(along: Along, unit: Vectors, duration: Array, given: PyTree) -> tuple[Array, ...]:
    """Return the excess over each limit at one sample of a trajectory.

    `unit` is the sample's height, velocity, acceleration and jerk for pieces of 1 s mean duration,
    `duration` the true mean duration [s] of a piece, and `given` the gravity and the limits.
    """
    rate = reciprocal(duration)
    rates = [rate, rate * rate, rate * rate * rate]
    vel, acc, jerk = (
        tuple(value * power for value in vector)
        for vector, power in zip(unit[1:], rates, strict=True)
    )
    parts: dict[str, PyTree] = {"height": unit[0][0], "vel": vel, "acc": acc, "jerk": jerk}
    return along.excess(Motion(**parts), given)


def _penalty(along: Along, unit: Vectors, duration: Array, given: PyTree) -> tuple[Array, Array]:
    numbers, share, width = along.split(given)
    excess = sample_excess(along, unit, duration, numbers)
    hinges = [
        factor * smooth_hinge(value + share * margin, width)
        for value, margin, factor in zip(excess, along.margins, along.hinge_weights, strict=True)
    ]
    return duration * _total(hinges), functools.reduce(jnp.maximum, excess)


def _slopes(along: Along, weight: Array, free: tuple, fixed: tuple) -> tuple[Array, tuple]:
    value, pull_back, worst = jax.vjp(lambda *x: _penalty(along, *x, *fixed), *free, has_aux=True)
    return worst, (weight * value, *pull_back(jnp.ones_like(value) * weight))


def _curvature(
    along: Along, sample: _Sample, free: tuple, given: PyTree, direction: tuple
) -> tuple:
    columns, duration, given_change = direction
    moving, tangents, still = free, (unit_motion(sample.row, columns), duration), (given,)
    if given_change is not None:
        moving, tangents, still = (*free, given), (*tangents, given_change), ()

    def slopes(*moving: PyTree) -> tuple:
        return _slopes(along, sample.weight, (*moving, *still), ())[1]

    return jax.jvp(slopes, moving, tangents)[1]
