"""The compiled programs: one attempt at one case, or at the lanes of all devices.

Batches lie on devices in equal shares of lanes, and are cut into chunks of a few fixed sizes:
padding to these keeps a new batch size from compiling the solver anew.

One case is sent as one vector, and its plan comes back as one: each array that crosses into or out
of a compiled program costs some microseconds, a good part of the time of a plan of one case.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding
from jaxtyping import PyTree

from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt, is_unsolved, mark_bad_input
from planner_jax.core.rules import require_shapes

# Lanes of a device in one call. Few sizes, because every one is a program of its own to compile.
BUCKETS = (16, 128, 1024, 8192, 65536)
_CPU_CHUNK, _GPU_CHUNK = 256, 65536  # what fits the cache of a core, and what fills a GPU
_GPU_BUSY = 8192  # starts in one call that keep a GPU busy
_GPU_LEAST = 128  # lanes of a call: fewer take as long, and another program to compile
_MORE = 8  # one more program is worth its compilation if it spares one lane in so many
LANES = PartitionSpec("lanes")


@dataclasses.dataclass(frozen=True)
class Sizes:
    """The sizes of the calls of one attempt, in lanes of a device."""

    most: int
    busy: int  # that keep a GPU busy
    least: int = BUCKETS[0]

    def next(self, num: int) -> int:
        """Return the size of the call that takes the next of `num` lanes.

        Where they would fill less than half of it, calls of the next smaller size take them if
        these still keep a GPU busy.
        """
        needed = max(num, self.least)
        fits = next((bucket for bucket in BUCKETS if needed <= bucket <= self.most), self.most)
        smaller = max((bucket for bucket in BUCKETS if bucket < fits), default=0)
        return smaller if smaller >= self.busy and 2 * num <= fits else fits

    def cuts(self, num: int) -> Iterator[tuple[int, int]]:
        """Yield the first lane and the size of every call that `num` lanes take.

        The few lanes that are left after many calls take another call of the same size, unless
        that is much more work: to compile for a smaller one would take longer.
        """
        first = size = 0
        while first < num:
            smaller = self.next(num - first)
            if size - smaller > first // _MORE or smaller > size:
                size = smaller
            yield first, size
            first += size


def sizes_of(planner: Planner, attempt: Attempt, chunk: int | None, mesh: Mesh) -> Sizes:
    """Return the sizes of an attempt's calls: of `chunk` lanes, or of what suits the device."""
    busy = _GPU_BUSY // attempt.starts
    if chunk is not None:
        return Sizes(chunk, busy)
    if mesh.devices[0].platform != "cpu":
        return Sizes(max(_GPU_LEAST, _GPU_CHUNK // attempt.starts), busy, _GPU_LEAST)
    # One after another, few lanes are as quick as many, and no core waits long for the last ones.
    if planner.is_sequential:
        return Sizes(BUCKETS[0], busy)
    starts = 1 << (attempt.starts - 1).bit_length()  # or more: a power of two
    return Sizes(max(BUCKETS[0], _CPU_CHUNK // starts), busy)


def on_devices(planner: Planner, devices: Sequence[jax.Device] | None) -> tuple[Planner, Mesh]:  # pyright: ignore[reportInvalidTypeForm]
    """Return the planner with its arrays on devices, by default all local ones, and their mesh."""
    mesh = Mesh(np.array(jax.local_devices() if devices is None else devices), ("lanes",))
    if jax.tree.leaves(planner):
        planner = jax.device_put(planner, whole(mesh))
    return planner, mesh


def length(tree: PyTree) -> int:
    """Return the number of lanes of all leaves."""
    return jax.tree.leaves(tree)[0].shape[0]


def is_one_cpu(mesh: Mesh) -> bool:
    """Return whether the only device is the host itself."""
    return mesh.size == 1 and mesh.devices[0].platform == "cpu"


def sharding(mesh: Mesh) -> Sharding:
    """Return equal shares of the lanes; for one device the form that JAX handles quickest."""
    return NamedSharding(mesh, LANES) if mesh.size > 1 else SingleDeviceSharding(mesh.devices[0])


def whole(mesh: Mesh) -> Sharding:
    """Return the sharding of what every device has in full."""
    return NamedSharding(mesh, PartitionSpec()) if mesh.size > 1 else sharding(mesh)


@functools.lru_cache(maxsize=4096)
def number(mesh: Mesh, value: int) -> Array:
    """Return a number that every device has; sent but once, since each transfer takes time."""
    return jax.device_put(np.int32(value), whole(mesh))


def apart(mesh: Mesh, function: Callable, *specs: PartitionSpec) -> Callable:
    """Return the function that every device computes of its own share of the lanes.

    Args:
        mesh: the devices.
        function: of arrays with the lanes first.
        specs: how its arguments are split, one each; by default all by their lanes.
    """
    if mesh.size == 1:
        return function
    # Without the check of replication: the lanes of a device share nothing with another's.
    return jax.shard_map(
        function, mesh=mesh, in_specs=specs or LANES, out_specs=LANES, check_vma=False
    )


def placed(tree: PyTree, mesh: Mesh) -> PyTree:
    """Return the tree with equal shares of its lanes on every device."""
    target = sharding(mesh)

    def is_there(leaf: Array) -> bool:
        own = leaf.sharding  # the comparison by == is the quicker one
        return own == target or own.is_equivalent_to(target, leaf.ndim)

    if all(map(is_there, jax.tree.leaves(tree))):
        return tree
    return jax.device_put(tree, target)


# XLA tries its own kernels for every product of matrices, a third of the time that a GPU's program
# takes to compile; the library's are as quick for products of such shapes. No effect on a CPU.
_COMPILER_OPTIONS: Any = {"xla_gpu_enable_triton_gemm": False}


_Layout = tuple[tuple[tuple[int, ...], np.dtype], ...]  # shapes and dtypes of a tree's leaves


def solve_cases(planner: Planner, cases: PyTree, attempt: Attempt) -> PyTree:
    """Return the plans of one case, or of a batch with a leading axis on every leaf; pure.

    Every compiled plan is made here: a case that breaks a rule of its class is `BAD_INPUT`,
    whatever the planner makes of it.
    """
    require_shapes(cases)
    alone = cases.batch_shape == ()
    plans = planner.solve(cases, attempt) if alone else planner.solve_lanes(cases, attempt)
    return mark_bad_input(plans, cases)


@functools.partial(jax.jit, static_argnames=("attempt", "mesh"), compiler_options=_COMPILER_OPTIONS)
def solve_on_devices(
    planner: Planner, attempt: Attempt, mesh: Mesh, cases: PyTree
) -> tuple[PyTree, Array]:
    """Return plans of the lanes of every device, and how many it leaves unsolved, (devices,)."""

    def solve(planner: Planner, cases: PyTree) -> tuple[PyTree, Array]:
        return with_unsolved(solve_cases(planner, cases, attempt))

    return apart(mesh, solve, PartitionSpec(), LANES)(planner, cases)


def with_unsolved(plans: PyTree) -> tuple[PyTree, Array]:
    """Return the plans, and how many are unsolved, (1,)."""
    return plans, jnp.sum(is_unsolved(plans.status), keepdims=True)


@dataclasses.dataclass
class Compilation:
    """Whether a program of `solve_on_devices` has been compiled."""

    is_done: bool = False


def compilation_of(planner: Planner, attempt: Attempt, num: int, cases: PyTree) -> Compilation:
    """Return the compilation of the `solve_on_devices` that takes `num` lanes of a device."""
    own = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(planner))
    lanes = tuple((leaf.shape[1:], leaf.dtype) for leaf in jax.tree.leaves(cases))
    return _compilation((jax.tree.structure((planner, cases)), own, lanes, attempt, num))


@functools.cache
def _compilation(program: Hashable) -> Compilation:
    """Return the same object for the same program."""
    return Compilation()


def solve_one(planner: Planner, case: PyTree, attempt: Attempt) -> PyTree:
    """Return the plan of one case, with NumPy leaves."""
    return call_packed(_solve_one, attempt, planner, case)


def _solve_one(attempt: Attempt, planner: Planner, case: PyTree) -> PyTree:
    return solve_cases(planner, case, attempt)


def call_packed(function: Callable, static: Hashable, own: PyTree, case: PyTree) -> PyTree:
    """Return `function(static, own, case)` with NumPy leaves.

    Args:
        function: pure; compiled once for each static value and for each layout of the rest.
        static: hashable, a constant of the program.
        own: a pytree that stays where it is, such as a planner.
        case: a pytree with NumPy leaves, one of them floating at least.
    """
    leaves, tree = jax.tree.flatten(case)
    arrays = [np.asarray(leaf) for leaf in leaves]
    kept, own_tree = jax.tree.flatten(own)
    program = _program(function, static, own_tree, _layout(kept), tree, _layout(arrays))
    pieces = [array.ravel() for array in arrays]
    vector = np.concatenate(pieces, dtype=program.dtype, casting="unsafe")
    packed = np.asarray(program.run(kept, vector))
    result = program.result
    found = [packed[where].reshape(shape) for where, shape in result.fields]
    for k, dtype in result.others:
        found[k] = found[k].astype(dtype)
    return jax.tree.unflatten(result.tree, found)


def _layout(leaves: Sequence[PyTree]) -> _Layout:
    """Return what a program must know of arrays."""
    return tuple([(leaf.shape, leaf.dtype) for leaf in leaves])


@dataclasses.dataclass
class _Result:
    """How the leaves of a tree lie in a vector; known as soon as a function has been traced."""

    tree: PyTree = None
    fields: list[tuple[slice, tuple[int, ...]]] = dataclasses.field(default_factory=list)
    # Leaves of another dtype than the vector, and their dtypes.
    others: list[tuple[int, np.dtype]] = dataclasses.field(default_factory=list)


@dataclasses.dataclass(frozen=True)
class _Program:
    """A compiled function of the leaves that stay and a vector, which returns a vector."""

    run: Callable[[list[PyTree], np.ndarray], Array]
    dtype: np.dtype  # of both vectors
    result: _Result


@functools.cache
def _program(
    function: Callable,
    static: Hashable,
    own_tree: PyTree,
    own: _Layout,
    tree: PyTree,
    layout: _Layout,
) -> _Program:
    """Return the program for trees of these shapes and dtypes."""
    canonical = jax.dtypes.canonicalize_dtype
    dtype = canonical(np.result_type(*[d for _, d in layout if np.issubdtype(d, np.floating)]))
    ends = np.cumsum([math.prod(shape) for shape, _ in layout])
    result = _Result()

    def packed(kept: list[PyTree], vector: Array) -> Array:
        leaves = [
            piece.reshape(shape).astype(canonical(kind))
            for piece, (shape, kind) in zip(jnp.split(vector, ends[:-1]), layout, strict=True)
        ]
        stays = jax.tree.unflatten(own_tree, kept)
        found = function(static, stays, jax.tree.unflatten(tree, leaves))
        leaves, result.tree = jax.tree.flatten(found)
        stops = np.cumsum([leaf.size for leaf in leaves]).tolist()
        result.fields = [
            (slice(stop - leaf.size, stop), leaf.shape)
            for stop, leaf in zip(stops, leaves, strict=True)
        ]
        result.others = [(k, leaf.dtype) for k, leaf in enumerate(leaves) if leaf.dtype != dtype]
        return jnp.concatenate([leaf.ravel().astype(dtype) for leaf in leaves])

    return _Program(jax.jit(packed), dtype, result)
