"""How batches lie on devices: chunks of a few fixed sizes, equal shares of lanes.

Padding to fixed sizes keeps a new batch size from compiling the solver anew.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding
from jaxtyping import PyTree

from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt

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


def on_devices(planner: Planner, devices: Sequence[jax.Device] | None) -> tuple[Planner, Mesh]:
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
