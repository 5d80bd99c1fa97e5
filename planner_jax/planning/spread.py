"""Plan a batch on several devices, for `plan`: each device plans its share in a thread of its own.

No device waits for another one. The loops of a share end when its own cases are planned, and the
host reads their conditions and counts for each device separately. A single program for all devices
would need the same number of iterations on each; XLA also failed to compile large ones.
"""

import functools
import threading
from collections.abc import Callable, Sequence

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding
from jaxtyping import PyTree

from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import BaseAttempt, is_resident
from planner_jax.host.threads import as_here, borrow_threads
from planner_jax.planning.plan import Watch
from planner_jax.planning.programs import Device, count_lanes
from planner_jax.planning.resident import take_lanes

# Plans the share of one device; the arguments are the device, its watch and its cases.
Solve = Callable[[Device, Watch, PyTree], PyTree]


def require_layout(chunk: object, devices: object) -> None:
    """Raise unless `chunk` is a whole number >= 1 and `devices` are distinct devices of JAX."""
    if chunk is not None:
        require_size("chunk", chunk)
    if devices is not None:
        if not isinstance(devices, Sequence | np.ndarray) or not all(
            isinstance(device, jax.Device) for device in devices
        ):
            raise ArgumentTypeError("devices", "a sequence of jax.Device", devices)
        if not len(devices):
            raise ArgumentError("devices", "at least one", shown="none")
        if len(set(devices)) < len(devices):
            raise ArgumentError("devices", "different", shown=", ".join(map(str, devices)))


def plan_shares(
    solve: Solve,
    cases: PyTree,
    devices: Sequence[Device],
    watch: Watch,
) -> PyTree:
    """Divide a batch equally among devices, which plan their shares, and join the plans.

    The plans of cases in NumPy arrays are in NumPy arrays. Those of cases in jax arrays stay on
    their devices; if the shares cannot be equal, the first device holds all plans.
    """
    num, size = count_lanes(cases), len(devices)
    share, resident = -(-num // size), is_resident(cases)
    together = NamedSharding(Mesh(np.array(devices), "lanes"), PartitionSpec("lanes"))
    if resident:
        shares = _split_resident(cases, share, together)
    else:
        part = lambda k: jax.tree.map(lambda x: x[k * share : (k + 1) * share], cases)  # noqa: E731
        shares = [part(k) for k in range(size)]

    def solve_there(device: Device, watch: Watch, some: PyTree) -> PyTree:
        with jax.default_device(device):
            return solve(device, watch, some)

    watches = _SharedWatch.of(watch, size)
    with borrow_threads(size) as pool:
        plans = list(pool.map(as_here(solve_there), devices, watches, shares))
    if not all(map(is_resident, plans)):
        return jax.tree.map(lambda *x: np.concatenate([np.asarray(y) for y in x])[:num], *plans)
    found = jax.tree.map(functools.partial(_join, together), *plans)
    if num % size == 0:
        return found
    there = jax.device_put(found, devices[0])  # JAX has no unequal shards
    return take_lanes(there, np.arange(num))


def _split_resident(cases: PyTree, share: int, together: Sharding) -> list[PyTree]:
    """Return the share of each device, on this device; repeats of the last case fill the shares."""
    num, size = count_lanes(cases), together.num_devices
    if num < share * size:
        cases = take_lanes(cases, np.arange(share * size))
    if any(leaf.sharding != together for leaf in jax.tree.leaves(cases)):
        cases = jax.device_put(cases, together)
    return [jax.tree.map(lambda leaf: leaf.addressable_data(k), cases) for k in range(size)]  # noqa: B023


def _join(together: Sharding, *parts: Array) -> Array:
    shape = (len(parts) * parts[0].shape[0], *parts[0].shape[1:])
    return jax.make_array_from_single_device_arrays(shape, together, list(parts))


class _SharedWatch(Watch):
    """The watch of one device; its reports are about all devices together."""

    def __init__(self, whole: Watch, place: int, counts: dict, lock: threading.Lock) -> None:
        self._whole, self._place, self._counts, self._lock = whole, place, counts, lock

    @classmethod
    def of(cls, whole: Watch, num: int) -> list["_SharedWatch"]:
        """Return the watches of `num` devices, whose reports go to `whole`, one at a time."""
        counts, lock = {}, threading.Lock()
        return [cls(whole, place, counts, lock) for place in range(num)]

    @property
    def waits(self) -> bool:
        """Return whether the host waits for each call, as a time limit or progress reports need."""
        return self._whole.waits

    @property
    def is_over(self) -> bool:
        """True if the time limit has passed."""
        return self._whole.is_over

    def report(self, planner: Planner, attempt: BaseAttempt, tried: int, cases: int) -> None:
        """Report the sums of tried cases and of cases over the devices that have begun."""
        with self._lock:
            known = self._counts.setdefault(attempt.place_among(tuple(planner.attempts)), {})
            known[self._place] = tried, cases
            sums = np.sum(list(known.values()), axis=0).tolist()
            self._whole.report(planner, attempt, *sums)
