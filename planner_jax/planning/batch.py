"""Batches of plans: chunks of a few fixed sizes, spread over the devices, round after round.

Padding to fixed sizes keeps a new batch size from compiling the solver anew. After each round the
lanes that are still unsolved are packed together for the next one. Every device solves its lanes
in a loop of its own and waits for no other.
"""

import dataclasses
import functools
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding

from planner_jax.planning.one_by_one import OneByOne
from planner_jax.planning.watch import Watch
from planner_jax.processors import usable_cores
from planner_jax.protocol import (
    Attempt,
    HostPlanner,
    LanesPlanner,
    Plan,
    Status,
    is_solved,
    is_unsolved,
    marked,
    out_of_time,
)
from planner_jax.rules import require_shapes
from planner_jax.threads import as_here

# Lanes of a device in one call. Few, because every one is a program of its own to compile.
BUCKETS = (16, 128, 1024, 8192, 65536)
_CPU_CHUNK, _GPU_CHUNK = 256, 65536  # what fits the cache of a core, and what fills a GPU
_GPU_BUSY = 8192  # starts in one call that keep a GPU busy
_GPU_LEAST = 128  # lanes of a call: fewer take it as long, and another program to compile
_MORE = 8  # a program more is worth its compilation if it spares one lane for so many
_LANES = PartitionSpec("lanes")
# XLA tries its own kernels for every product of matrices, a third of the time that a GPU's program
# takes to compile; the library's are as quick for products of such shapes. No effect on a CPU.
_COMPILER_OPTIONS: Any = {"xla_gpu_enable_triton_gemm": False}

PlanT = TypeVar("PlanT", bound=Plan)


@dataclasses.dataclass(frozen=True)
class _Sizes:
    """Of the calls of one attempt, in lanes of a device."""

    most: int
    busy: int  # that keep a GPU busy
    least: int = BUCKETS[0]

    def next(self, num: int) -> int:
        """Of the call that takes the next of `num` lanes.

        Where they would fill less than half of it, calls of the next smaller size take them if
        these still keep a GPU busy.
        """
        wanted = max(num, self.least)
        fits = next((bucket for bucket in BUCKETS if wanted <= bucket <= self.most), self.most)
        smaller = max((bucket for bucket in BUCKETS if bucket < fits), default=0)
        return smaller if smaller >= self.busy and 2 * num <= fits else fits

    def cuts(self, num: int) -> Iterator[tuple[int, int]]:
        """Where the calls that take `num` lanes begin, and their sizes.

        The few lanes that are left after many calls take another call of their size, unless that
        is much more work: to compile for a smaller one would take longer.
        """
        begin = size = 0
        while begin < num:
            smaller = self.next(num - begin)
            if size - smaller > begin // _MORE or smaller > size:
                size = smaller
            yield begin, size
            begin += size


def plan_batch(
    planner: Any,
    attempts: Sequence[Attempt],
    cases: Any,
    chunk: int | None,
    devices: Sequence[Any] | None,
    watch: Watch,
) -> tuple[Any, Any]:
    """Attempts at B cases, each at the lanes that are still unsolved.

    Args:
        planner: that makes them.
        attempts: in order, one or more.
        cases: a leading axis of B on every leaf.
        chunk: lanes a device solves in one call; None for what suits it.
        devices: that share the work; None for all local ones.
        watch: after whose end no attempt but the first is begun.

    Returns:
        plans: with NumPy leaves, or where all leaves of the cases are jax arrays, with
            those, so that nothing leaves the devices.
        unsolved: numbers that are all zero if no lane is unsolved.
    """
    mesh = Mesh(np.array(jax.local_devices() if devices is None else devices), ("lanes",))
    if jax.tree.leaves(planner):
        planner = jax.device_put(planner, _whole(mesh))
    resident = all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(cases))
    num = _length(cases)
    in_one_call = num == _sizes(planner, attempts[0], chunk, mesh).next(num)
    # One CPU's memory is the host's: there a thread for each core plans chunks, and they are cut
    # and joined without programs, which would be compiled for every new size.
    if resident and (in_one_call or not _is_one_cpu(mesh)):
        return _plan_resident(planner, attempts, cases, chunk, mesh, watch)
    plans, unsolved = _plan_from_host(planner, attempts, cases, chunk, mesh, watch)
    return (jax.device_put(plans, _sharding(mesh)) if resident else plans), unsolved


def compile_at_once(planner: Any, attempts: Sequence[Attempt], cases: Any) -> Any:
    """Try all attempts at the first of B cases, each in a thread of its own.

    Afterwards the programs are compiled that `plan_batch` takes for as many on all local devices.

    Args:
        planner: that makes them.
        attempts: one or more.
        cases: a leading axis of B on every leaf.

    Returns:
        What the first attempt makes of the cases, (B, ...) or the first of them.
    """
    mesh = Mesh(np.array(jax.local_devices()), ("lanes",))
    cases = jax.tree.map(np.asarray, cases)

    def tried(attempt: Attempt) -> Any:
        (lanes, num), *_ = _calls(
            np.arange(_length(cases)), _sizes(planner, attempt, None, mesh), mesh
        )
        part = jax.device_put(jax.tree.map(lambda leaf: leaf[lanes], cases), _sharding(mesh))
        found, _ = _solve(planner, attempt, mesh, part)
        _COMPILED.add(_program(planner, attempt, lanes.size // mesh.size, cases))
        return jax.tree.map(lambda leaf: leaf[:num], found)

    with ThreadPoolExecutor(len(attempts)) as pool:
        return next(iter(list(pool.map(as_here(tried), attempts))))


def solve_cases(planner: Any, cases: Any, attempt: Attempt) -> Any:
    """The plans of one case, or of a batch with a leading axis on every leaf; pure.

    All that is planned in compiled programs is planned here: what breaks a rule of its case's
    class is `BAD_INPUT`, whatever the planner makes of it.
    """
    require_shapes(cases)
    if cases.batch_shape == ():
        plans = planner.solve(cases, attempt)
    elif isinstance(planner, LanesPlanner):
        plans = planner.solve_lanes(cases, attempt)
    else:
        plans = jax.vmap(lambda case: planner.solve(case, attempt))(cases)
    return marked(plans, cases)


def plan_on_host(
    planner: HostPlanner, attempts: Sequence[Attempt], cases: Any, watch: Watch
) -> tuple[Any, int]:
    """As `plan_batch`, by a planner that works on the host; NumPy leaves. One case will do, too."""
    alone = cases.batch_shape == ()
    cases = jax.tree.map(lambda leaf: np.asarray(leaf)[None] if alone else np.asarray(leaf), cases)
    plans: Any = None
    lanes = np.arange(_length(cases))
    for attempt in attempts:
        if plans is not None:
            due = attempt.is_due(plans)
            lanes = np.flatnonzero(due)
            if lanes.size == 0:
                continue
            if watch.is_over:
                plans = out_of_time(plans, due)
                break
        watch.tell(planner, attempt, 0, lanes.size)
        some = jax.tree.map(lambda leaf, lanes=lanes: leaf[lanes], cases)
        later = marked(planner.solve_on_host(some, attempt), some)
        plans = jax.tree.map(np.array, later) if plans is None else merged(plans, later, lanes)
        watch.tell(planner, attempt, lanes.size, lanes.size)
    unsolved = np.sum(is_unsolved(plans.status))
    return jax.tree.map(lambda leaf: leaf[0], plans) if alone else plans, unsolved


def _plan_from_host(
    planner: Any,
    attempts: Sequence[Attempt],
    cases: Any,
    chunk: int | None,
    mesh: Mesh,
    watch: Watch,
) -> tuple[Any, int]:
    """As `plan_batch`, of cases in NumPy arrays."""
    cases = jax.tree.map(np.asarray, cases)
    lanes = np.arange(_length(cases))
    plans: Any = None
    for attempt in attempts:
        if plans is not None:
            due = attempt.is_due(plans)
            lanes = np.flatnonzero(due)
            if lanes.size == 0:
                continue
            if watch.is_over:
                plans = out_of_time(plans, due)
                break
        calls = _calls(lanes, _sizes(planner, attempt, chunk, mesh), mesh)
        may_end = plans is not None
        found = _solved_from_host(planner, attempt, cases, calls, mesh, watch, may_end)
        if plans is None:
            trimmed = [
                jax.tree.map(lambda leaf, n=num: np.asarray(leaf)[:n], part)
                for part, (_, num) in zip(found, calls, strict=True)
            ]
            plans = jax.tree.map(lambda *leaves: np.concatenate(leaves), *trimmed)
        else:
            untried = np.zeros(len(plans.status), bool)
            for (call, num), later in zip(calls, found, strict=True):
                if later is None:
                    untried[call[:num]] = True
                else:
                    plans = merged(plans, later, call[:num])
            if untried.any():
                plans = out_of_time(plans, untried)
    return plans, np.sum(is_unsolved(plans.status))


def _plan_resident(
    planner: Any,
    attempts: Sequence[Attempt],
    cases: Any,
    chunk: int | None,
    mesh: Mesh,
    watch: Watch,
) -> tuple[Any, Array]:
    """As `plan_batch`, of cases in jax arrays; only how many are unsolved comes to the host.

    Every device plans its own share, without asking the others for a lane.
    """
    num = _length(cases)
    if num % mesh.size:  # the last lane is there again until all shares are equal
        cases = _taken(cases, np.arange(-(-num // mesh.size) * mesh.size))
    cases = _placed(cases, mesh)
    first, *others = attempts
    sizes = _sizes(planner, first, chunk, mesh)
    watch.tell(planner, first, 0, num)
    plans, unsolved = _first_plans(planner, first, cases, sizes, mesh)
    for attempt in others:
        before, due = plans.status, unsolved
        if attempt.within is not None:
            before, due = _due(mesh, attempt.within, plans)
        due.copy_to_host_async()  # on its way as soon as it is known
        most = np.asarray(due).max()  # of the devices
        if most == 0:
            continue
        if watch.is_over:
            plans = out_of_time(plans, attempt.is_due(plans))
            break
        watch.tell(planner, attempt, 0, np.asarray(due).sum())
        sizes = _sizes(planner, attempt, chunk, mesh)
        for begin, size in sizes.cuts(most):
            part, lanes = _cut_unsolved(mesh, size, cases, before, _number(mesh, begin))
            later, _ = _solve(planner, attempt, mesh, part)
            plans, unsolved = _merged_locally(mesh, plans, later, lanes)
    if num % mesh.size:  # arrays have equal shares or none
        plans = _taken(jax.device_put(plans, mesh.devices[0]), np.arange(num))
    return plans, unsolved


def _first_plans(
    planner: Any, attempt: Attempt, cases: Any, sizes: _Sizes, mesh: Mesh
) -> tuple[Any, Array]:
    """One attempt at all lanes of every device, chunk by chunk; as `_solve`."""
    share = _length(cases) // mesh.size
    if share == sizes.next(share):
        return _solve(planner, attempt, mesh, cases)
    cuts = list(sizes.cuts(share))

    def solve(begin: int, size: int) -> Any:
        part = _cut(mesh, size, cases, _number(mesh, begin))
        return _solve(planner, attempt, mesh, part)[0]

    programs = {size: _program(planner, attempt, size, cases) for _, size in cuts}
    found: dict[int, Any] = {}
    if len(set(programs.values()) - _COMPILED) > 1:  # compiled at the same time
        firsts = {size: begin for begin, size in reversed(cuts)}
        with ThreadPoolExecutor(len(firsts)) as pool:
            made = pool.map(as_here(solve), firsts.values(), firsts)
            found = dict(zip(firsts.values(), made, strict=True))
        _COMPILED.update(programs.values())
    parts = [found[begin] if begin in found else solve(begin, size) for begin, size in cuts]
    return _joined_locally(mesh, parts, share)


def _is_one_cpu(mesh: Mesh) -> bool:
    """Whether the only device is the host itself."""
    return mesh.size == 1 and mesh.devices[0].platform == "cpu"


def _length(tree: Any) -> int:
    return jax.tree.leaves(tree)[0].shape[0]


def _sizes(planner: Any, attempt: Attempt, chunk: int | None, mesh: Mesh) -> _Sizes:
    """As `chunk` says, or as it suits the device."""
    busy = _GPU_BUSY // attempt.starts
    if chunk is not None:
        return _Sizes(chunk, busy)
    if mesh.devices[0].platform != "cpu":
        return _Sizes(max(_GPU_LEAST, _GPU_CHUNK // attempt.starts), busy, _GPU_LEAST)
    # One after another, few are as quick as many, and no core waits long for the others' last.
    if isinstance(planner, OneByOne):
        return _Sizes(BUCKETS[0], busy)
    starts = 1 << (attempt.starts - 1).bit_length()  # or more: a power of two
    return _Sizes(max(BUCKETS[0], _CPU_CHUNK // starts), busy)


def _calls(lanes: np.ndarray, sizes: _Sizes, mesh: Mesh) -> list[tuple[np.ndarray, int]]:
    """The lanes of every call, filled up with its first one, and how many of them count."""
    calls = []
    for begin, size in sizes.cuts(-(-lanes.size // mesh.size)):
        length = size * mesh.size
        part = lanes[begin * mesh.size :][:length]
        calls.append((np.append(part, np.full(length - part.size, part[0])), part.size))
    return calls


def _sharding(mesh: Mesh) -> Sharding:
    """Equal shares of the lanes on every device; for one device what JAX handles quickest."""
    return NamedSharding(mesh, _LANES) if mesh.size > 1 else SingleDeviceSharding(mesh.devices[0])


def _whole(mesh: Mesh) -> Sharding:
    """The same on every device."""
    return NamedSharding(mesh, PartitionSpec()) if mesh.size > 1 else _sharding(mesh)


@functools.lru_cache(maxsize=4096)
def _number(mesh: Mesh, value: int) -> Array:
    """A number that every device has; sent but once, since the way there takes time."""
    return jax.device_put(np.int32(value), _whole(mesh))


def _apart(mesh: Mesh, function: Callable, *specs: PartitionSpec) -> Callable:
    """A function that every device carries out on its own share of the lanes.

    Args:
        mesh: the devices.
        function: of arrays with the lanes first.
        specs: how its arguments are split, one each; by default all by their lanes.
    """
    if mesh.size == 1:
        return function
    # Without the check of replication: the lanes of a device share nothing with another's.
    return jax.shard_map(
        function, mesh=mesh, in_specs=specs or _LANES, out_specs=_LANES, check_vma=False
    )


def _placed(tree: Any, mesh: Mesh) -> Any:
    """The tree with equal shares of its lanes on every device."""
    placed = _sharding(mesh)

    def is_there(leaf: Array) -> bool:
        own = leaf.sharding  # equality is quicker to find out
        return own == placed or own.is_equivalent_to(placed, leaf.ndim)

    if all(map(is_there, jax.tree.leaves(tree))):
        return tree
    return jax.device_put(tree, placed)


def _solved_from_host(
    planner: Any,
    attempt: Attempt,
    cases: Any,
    calls: list[tuple[np.ndarray, int]],
    mesh: Mesh,
    watch: Watch,
    may_end: bool,
) -> list[Any]:
    """One attempt at the lanes of every call.

    Where it may end early, there is None for the calls that were not begun in time.
    """
    found, tried, cases_left = [], 0, sum(num for _, num in calls)
    watch.tell(planner, attempt, tried, cases_left)
    each = _each_from_host(planner, attempt, cases, calls, mesh, watch, may_end)
    for one, (_, num) in zip(each, calls, strict=True):
        found.append(one)
        if one is not None:
            tried += num
            watch.tell(planner, attempt, tried, cases_left)
    return found


def _each_from_host(
    planner: Any,
    attempt: Attempt,
    cases: Any,
    calls: list[tuple[np.ndarray, int]],
    mesh: Mesh,
    watch: Watch,
    may_end: bool,
) -> Iterator[Any]:
    """As `_solved_from_host`, call by call; on one CPU device with a thread for each core.

    One thread more hands over the next call while the others compute.
    """
    threads = min(len(calls), usable_cores() + 1) if _is_one_cpu(mesh) else 1
    placed = _sharding(mesh)

    def solve(call: tuple[np.ndarray, int]) -> Any:
        if may_end and watch.is_over:
            return None
        lanes, _ = call
        part = jax.device_put(jax.tree.map(lambda leaf: leaf[lanes], cases), placed)
        found, _ = _solve(planner, attempt, mesh, part)
        return jax.block_until_ready(found) if threads > 1 or watch.waits else found

    if threads == 1:  # calls return before they are done, so that the next is under way
        yield from map(solve, calls) if watch.waits else [solve(call) for call in calls]
        return
    # A first call compiles, once for all threads; what is compiled is found by all.
    program = _program(planner, attempt, calls[0][0].size, cases)
    alone = [] if program in _COMPILED else [solve(calls[0])]
    _COMPILED.add(program)
    with ThreadPoolExecutor(threads) as pool:
        later = pool.map(as_here(solve), calls[len(alone) :])
        yield from alone
        yield from later


_COMPILED: set[Hashable] = set()  # what `_program` names of the programs that have been called


def _program(planner: Any, attempt: Attempt, num: int, cases: Any) -> Hashable:
    """What tells a compiled `_solve` of so many lanes apart from the others."""
    own = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(planner))
    given = tuple((leaf.shape[1:], leaf.dtype) for leaf in jax.tree.leaves(cases))
    return jax.tree.structure((planner, cases)), own, given, attempt, num


@functools.partial(jax.jit, static_argnames=("attempt", "mesh"), compiler_options=_COMPILER_OPTIONS)
def _solve(planner: Any, attempt: Attempt, mesh: Mesh, cases: Any) -> tuple[Any, Array]:
    """One attempt at the lanes of every device, and how many each leaves unsolved, (devices,)."""

    def solve(planner: Any, cases: Any) -> tuple[Any, Array]:
        return _counted(solve_cases(planner, cases, attempt))

    return _apart(mesh, solve, PartitionSpec(), _LANES)(planner, cases)


@jax.jit
def _taken(tree: Any, lanes: Any) -> Any:
    """Some lanes; the last one for those behind it."""
    return jax.tree.map(lambda leaf: leaf[jnp.minimum(lanes, leaf.shape[0] - 1)], tree)


@functools.partial(jax.jit, static_argnames=("mesh", "size"))
def _cut(mesh: Mesh, size: int, tree: Any, begin: Any) -> Any:
    """The next lanes of every device's share, filled up with its last one."""

    def cut(tree: Any, begin: Array) -> Any:
        return _taken(tree, begin + jnp.arange(size))

    return _apart(mesh, cut, _LANES, PartitionSpec())(tree, begin)


@functools.partial(jax.jit, static_argnames=("mesh", "size"))
def _cut_unsolved(mesh: Mesh, size: int, tree: Any, status: Array, begin: Any) -> tuple[Any, Array]:
    """The next unsolved lanes of every device's share, and where they are.

    Filled up with the last lane, said to be behind the share.
    """

    def cut(tree: Any, status: Array, begin: Array) -> tuple[Any, Array]:
        (num,) = status.shape
        (unsolved,) = jnp.nonzero(is_unsolved(status), size=num, fill_value=num)
        lanes = _taken(unsolved, begin + jnp.arange(size))
        return _taken(tree, lanes), lanes

    return _apart(mesh, cut, _LANES, _LANES, PartitionSpec())(tree, status, begin)


@functools.partial(jax.jit, static_argnames=("mesh", "within"))
def _due(mesh: Mesh, within: float, plans: Any) -> tuple[Array, Array]:
    """Statuses, and how many are unsolved, (devices,), as if plans farther off were solved."""

    def due(plans: Any) -> tuple[Array, Array]:
        near = plans.violation <= within
        status = jnp.where(near, plans.status, jnp.full_like(plans.status, Status.FEASIBLE))
        return status, jnp.sum(is_unsolved(status), keepdims=True)

    return _apart(mesh, due)(plans)


@functools.partial(jax.jit, static_argnames=("mesh", "share"))
def _joined_locally(mesh: Mesh, parts: list[Any], share: int) -> tuple[Any, Array]:
    """One after another the parts of every device, which makes its share; as `_solve`."""

    def join(*parts: Any) -> tuple[Any, Array]:
        return _counted(jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:share], *parts))

    return _apart(mesh, join)(*parts)


def _counted(plans: Any) -> tuple[Any, Array]:
    """The plans, and how many are unsolved, (1,)."""
    return plans, jnp.sum(is_unsolved(plans.status), keepdims=True)


def _better(later: Any, plans: Any) -> Any:
    """Where a later attempt did better."""
    return is_solved(later.status) | (later.violation < plans.violation)


def better_of(plans: Any, later: Any, where: Array) -> Any:
    """The plans, with later ones where these do better among the cases that `where` tells."""
    chosen = where & _better(later, plans)

    def pick(old: Array, new: Array) -> Array:
        return jnp.where(chosen.reshape(chosen.shape + (1,) * (new.ndim - chosen.ndim)), new, old)

    return jax.tree.map(pick, plans, later)


def first_solved(plan_of: Callable[[Array], PlanT], num: Array | int, best: PlanT) -> PlanT:
    """The first of a line of plans of one case that is solved, or the best where none is.

    Args:
        plan_of: makes the plan at a place () int32 of the line.
        num: () int32, of plans in the line.
        best: what there is already; if it is solved, nothing is made.
    """

    def next_one(state: tuple[Array, PlanT]) -> tuple[Array, PlanT]:
        place, best = state
        return place + 1, better_of(best, plan_of(place), jnp.asarray(True))

    def is_open(state: tuple[Array, PlanT]) -> Array:
        place, best = state
        return (place < num) & ~is_solved(best.status)

    return lax.while_loop(is_open, next_one, (jnp.zeros((), jnp.int32), best))[1]


def merged(plans: Any, later: Any, lanes: np.ndarray) -> Any:
    """The plans, in place, with those of some lanes replaced by later ones that are better."""
    later = jax.tree.map(lambda leaf: np.asarray(leaf)[: lanes.size], later)
    better = _better(later, jax.tree.map(lambda leaf: leaf[lanes], plans))

    def replace(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        old[lanes[better]] = new[better]
        return old

    return jax.tree.map(replace, plans, later)


@functools.partial(jax.jit, static_argnames="mesh")
def _merged_locally(mesh: Mesh, plans: Any, later: Any, lanes: Array) -> tuple[Any, Array]:
    """As on the host, of every device's share, and how many it then has unsolved."""

    def merge(plans: Any, later: Any, lanes: Array) -> tuple[Any, Array]:
        kept = better_of(_taken(plans, lanes), later, jnp.ones(lanes.shape, bool))

        def replace(old: Array, new: Array) -> Array:
            return old.at[lanes].set(new, mode="drop")

        return _counted(jax.tree.map(replace, plans, kept))

    return _apart(mesh, merge)(plans, later, lanes)
