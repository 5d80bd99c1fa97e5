"""The compiled programs: one attempt at one case, or at the lanes of all devices.

A lane is one case of a batch. Batches are spread over the devices in equal shares of lanes, and cut
into chunks of a few fixed sizes, so that a new batch size does not compile the solver again.

One case is sent to a program as one vector, and its plan is returned as one vector: each array that
enters or leaves a program costs some microseconds, a large part of the time of one plan.
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

# Lanes of a device in one call. The sizes are few, because each needs a program of its own.
BUCKETS = (16, 128, 1024, 8192, 65536)
_CPU_CHUNK, _GPU_CHUNK = 256, 65536  # fits the cache of a core; fills a GPU
_GPU_BUSY = 8192  # starts in one call that keep a GPU busy
_GPU_LEAST = 128  # lanes of a call: fewer take as long, and one more program
_SPARED = 8  # one more program is compiled if it saves one lane in so many
LANES = PartitionSpec("lanes")


@dataclasses.dataclass(frozen=True)
class Sizes:
    """The sizes of the calls of one attempt, in lanes of a device."""

    most: int
    busy: int  # lanes that keep a GPU busy
    least: int = BUCKETS[0]

    def next(self, num: int) -> int:
        """Return the size of the call that takes the next of `num` lanes.

        If these fill at most half of a size, the next smaller size is used, provided that it keeps
        a GPU busy.
        """
        needed = max(num, self.least)
        fits = next((bucket for bucket in BUCKETS if needed <= bucket <= self.most), self.most)
        smaller = max((bucket for bucket in BUCKETS if bucket < fits), default=0)
        return smaller if smaller >= self.busy and 2 * num <= fits else fits

    def cuts(self, num: int) -> Iterator[tuple[int, int]]:
        """Yield the first lane and the size of every call that `num` lanes take.

        The last lanes after many calls take another call of the same size, unless that is much more
        work, because compiling a program of a smaller size would take longer.
        """
        first = size = 0
        while first < num:
            smaller = self.next(num - first)
            if size - smaller > first // _SPARED or smaller > size:
                size = smaller
            yield first, size
            first += size


def sizes_of(planner: Planner, attempt: Attempt, chunk: int | None, mesh: Mesh) -> Sizes:
    """Return the sizes of an attempt's calls: `chunk` lanes, or a number that suits the device."""
    busy = _GPU_BUSY // attempt.starts
    if chunk is not None:
        return Sizes(chunk, busy)
    if mesh.devices[0].platform != "cpu":
        return Sizes(max(_GPU_LEAST, _GPU_CHUNK // attempt.starts), busy, _GPU_LEAST)
    # Solved one after another, few lanes are as fast as many, and no core waits long at the end.
    if planner.is_sequential:
        return Sizes(BUCKETS[0], busy)
    starts = 1 << (attempt.starts - 1).bit_length()  # rounded up to a power of two
    return Sizes(max(BUCKETS[0], _CPU_CHUNK // starts), busy)


def on_devices(planner: Planner, devices: Sequence[jax.Device] | None) -> tuple[Planner, Mesh]:  # pyright: ignore[reportInvalidTypeForm]
    """Return a planner with its arrays on the devices, by default all local ones, and a mesh."""
    mesh = Mesh(np.array(jax.local_devices() if devices is None else devices), ("lanes",))
    if jax.tree.leaves(planner):
        planner = jax.device_put(planner, replicated_sharding(mesh))
    return planner, mesh


def count_lanes(tree: PyTree) -> int:
    """Return the number of lanes of all leaves."""
    return jax.tree.leaves(tree)[0].shape[0]


def is_one_cpu(mesh: Mesh) -> bool:
    """Return whether the only device is the host itself."""
    return mesh.size == 1 and mesh.devices[0].platform == "cpu"


def lane_sharding(mesh: Mesh) -> Sharding:
    """Return the sharding into equal shares of lanes; for one device JAX's fastest form."""
    return NamedSharding(mesh, LANES) if mesh.size > 1 else SingleDeviceSharding(mesh.devices[0])


def replicated_sharding(mesh: Mesh) -> Sharding:
    """Return the sharding of arrays that every device has in full."""
    return NamedSharding(mesh, PartitionSpec()) if mesh.size > 1 else lane_sharding(mesh)


@functools.lru_cache(maxsize=4096)
def put_number(mesh: Mesh, value: int) -> Array:
    """Return a number on every device, cached because each transfer takes time."""
    return jax.device_put(np.int32(value), replicated_sharding(mesh))


def run_per_device(mesh: Mesh, function: Callable, *specs: PartitionSpec) -> Callable:
    """Return the function that every device computes for its own share of the lanes.

    `function` takes arrays with the lanes first. `specs` are the shardings of its arguments; by
    default all are split by lanes.
    """
    if mesh.size == 1:
        return function
    # The check of replication is off: lanes of different devices share nothing.
    return jax.shard_map(
        function, mesh=mesh, in_specs=specs or LANES, out_specs=LANES, check_vma=False
    )


def place_lanes(tree: PyTree, mesh: Mesh) -> PyTree:
    """Return the tree with equal shares of its lanes on every device."""
    target = lane_sharding(mesh)

    def is_there(leaf: Array) -> bool:
        own = leaf.sharding  # == is the faster comparison
        return own == target or own.is_equivalent_to(target, leaf.ndim)

    if all(map(is_there, jax.tree.leaves(tree))):
        return tree
    return jax.device_put(tree, target)


# XLA would try its own kernels for every matrix product, a third of the compile time on a GPU;
# cuBLAS is as fast for products of these shapes. No effect on a CPU.
_COMPILER_OPTIONS: Any = {"xla_gpu_enable_triton_gemm": False}
_Layout = tuple[tuple[tuple[int, ...], np.dtype], ...]  # shapes and dtypes of a tree's leaves


def solve_cases(planner: Planner, cases: PyTree, attempt: Attempt) -> PyTree:
    """Return the plans of one case, or of a batch with a leading axis on every leaf; pure.

    Every compiled plan is made here, so that every case that breaks a rule of its class has the
    status `BAD_INPUT`.
    """
    require_shapes(cases)
    alone = cases.batch_shape == ()
    plans = planner.solve(cases, attempt) if alone else planner.solve_lanes(cases, attempt)
    return mark_bad_input(plans, cases)


@functools.partial(jax.jit, static_argnames=("attempt", "mesh"), compiler_options=_COMPILER_OPTIONS)
def solve_on_devices(
    planner: Planner, attempt: Attempt, mesh: Mesh, cases: PyTree
) -> tuple[PyTree, Array]:
    """Return plans of each device's lanes, and the number that it leaves unsolved, (devices,)."""

    def solve(planner: Planner, cases: PyTree) -> tuple[PyTree, Array]:
        return with_unsolved(solve_cases(planner, cases, attempt))

    return run_per_device(mesh, solve, PartitionSpec(), LANES)(planner, cases)


def with_unsolved(plans: PyTree) -> tuple[PyTree, Array]:
    """Return the plans, and the number of unsolved ones, (1,)."""
    return plans, jnp.sum(is_unsolved(plans.status), keepdims=True)


# Keys of the programs of `solve_on_devices` that have been compiled.
compiled: set[Hashable] = set()


def program_key(planner: Planner, attempt: Attempt, num: int, cases: PyTree) -> Hashable:
    """Return the key of the `solve_on_devices` that takes `num` lanes of a device."""
    own = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(planner))
    lanes = tuple((leaf.shape[1:], leaf.dtype) for leaf in jax.tree.leaves(cases))
    return jax.tree.structure((planner, cases)), own, lanes, attempt, num


def solve_one(planner: Planner, case: PyTree, attempt: Attempt) -> PyTree:
    """Return the plan of one case, with NumPy leaves."""
    return call_packed(_solve_one, attempt, planner, case)


def _solve_one(attempt: Attempt, planner: Planner, case: PyTree) -> PyTree:
    return solve_cases(planner, case, attempt)


def call_packed(function: Callable, static: Hashable, own: PyTree, case: PyTree) -> PyTree:
    """Return `function(static, own, case)` with NumPy leaves.

    The pure function is compiled once for each hashable `static` and each layout of the other
    arguments. `own` is a pytree that stays on the device, such as a planner. `case` has NumPy
    leaves, at least one of them floating.
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
    """Return shapes and dtypes of arrays."""
    return tuple([(leaf.shape, leaf.dtype) for leaf in leaves])


@dataclasses.dataclass
class _Result:
    """Positions of a tree's leaves in a vector; known once the function has been traced."""

    tree: PyTree = None
    fields: list[tuple[slice, tuple[int, ...]]] = dataclasses.field(default_factory=list)
    # Indices and dtypes of leaves with another dtype than the vector.
    others: list[tuple[int, np.dtype]] = dataclasses.field(default_factory=list)


@dataclasses.dataclass(frozen=True)
class _Program:
    """A compiled function of the leaves of `own` and a vector, which returns a vector."""

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

    def run(kept: list[PyTree], vector: Array) -> Array:
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

    return _Program(jax.jit(run), dtype, result)
