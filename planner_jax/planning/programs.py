"""Compiled programs that make one attempt (search) at one case, or at a batch on one device.

A lane is one case of a batch. The lanes are cut into chunks of a few fixed sizes, so that a new
batch size compiles no new program.

A single case is packed into one vector for its program, which returns the plan as one vector: each
array that enters or leaves a program costs some microseconds, a large part of the time of one plan.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.arithmetic import float_type
from planner_jax.core.compiled import QUICK_OPTIONS, Fixed, Options
from planner_jax.core.planner import Planner
from planner_jax.core.protocol import BaseAttempt, Score, is_unsolved, mark_bad_input
from planner_jax.core.rules import require_shapes
from planner_jax.planning.traced import Layout, Results, Stored, load_or_trace, settings

if TYPE_CHECKING:  # `jax.Device` is no type for checkers
    from jaxlib._jax import Device
else:
    Device = jax.Device

# Numbers of lanes (cases) that a device solves in one call. Each number needs its own program.
BUCKETS = (16, 128, 1024, 16384, 65536)
# Greatest number of starting points in one call. More would not fit the cache of a CPU's core; on a
# GPU this number keeps all processors busy.
_CPU_CHUNK, _GPU_CHUNK = 256, 65536
_GPU_BUSY = 8192  # least number of starts in one call that keeps a GPU busy
# Least number of lanes of a call on a GPU; fewer lanes take the same time. The second number is for
# attempts whose padding is never searched.
_GPU_LEAST, GPU_LEAST_PADDED = 128, 1024
_SPARED = 8  # a smaller last call must save more than 1/8 of the lanes of all calls before it


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Numbers of lanes (cases) that one compiled call of an attempt may solve."""

    most: int  # greatest number of lanes of a call
    busy: int  # least number of lanes of a call that does not hold all remaining lanes
    least: int = BUCKETS[0]  # least number of lanes of a call

    def next(self, num: int) -> int:
        """Return how many lanes (cases) the next compiled call has if `num` lanes are unsolved.

        It is the smallest size in `BUCKETS`, or the field `least`, that holds `num` lanes, at most
        the field `most`. If the lanes fill at most half of it, the next smaller size is used,
        provided it is at least the fields `busy` and `least`. Further calls then plan the remaining
        lanes.
        """
        needed, sizes = max(num, self.least), (self.least, *BUCKETS)
        fits = next((size for size in sizes if needed <= size <= self.most), self.most)
        smaller = max((size for size in BUCKETS if size < fits), default=0)
        return smaller if smaller >= max(self.busy, self.least) and 2 * num <= fits else fits

    def cuts(self, num: int) -> Iterator[tuple[int, int]]:
        """Yield first lane (case) and number of lanes of each compiled call, for `num` lanes.

        A call has the size of the call before it, because another size needs another program. It is
        smaller only if this saves more than 1/8 of the lanes of all earlier calls together.
        """
        first = size = 0
        while first < num:
            smaller = self.next(num - first)
            if size - smaller > first // _SPARED or smaller > size:
                size = smaller
            yield first, size
            first += size


def sizes_of(planner: Planner, attempt: BaseAttempt, chunk: int | None, device: Device) -> Sizes:
    """Return how many cases one call may solve: `chunk`, or numbers that suit the device."""
    busy = _GPU_BUSY // attempt.starts
    if chunk is not None:
        return Sizes(chunk, busy)
    if not is_cpu(device):
        least = GPU_LEAST_PADDED if attempt.continues else min(_GPU_LEAST, max(busy, BUCKETS[0]))
        many = least if attempt.continues and attempt.starts > 1 else _GPU_CHUNK // attempt.starts
        return Sizes(max(least, many), busy, least)
    # If a core solves cases one after another, small chunks of cases keep all cores busy. Small
    # tiles of starting points do not wait for one slow search.
    if planner.is_sequential or (attempt.continues and attempt.starts > 1):
        return Sizes(BUCKETS[0], busy)
    starts = 1 << (attempt.starts - 1).bit_length()  # number of starts, up to a power of two
    return Sizes(max(BUCKETS[0], _CPU_CHUNK // starts), busy)


def count_lanes(tree: PyTree) -> int:
    """Return the number of lanes (cases) of a batch: the length of the leading axis."""
    return jax.tree.leaves(tree)[0].shape[0]


def is_cpu(device: Device) -> bool:
    """Return whether a device is a CPU."""
    return device.platform == "cpu"


@functools.lru_cache(maxsize=4096)
def put_number(device: Device, value: int) -> Array:
    """Return an integer as an array on a device; cached, because each transfer takes time.

    JAX compiles a program again if an argument is committed to a device. The arrays of most users
    are uncommitted, so an uncommitted number lets all calls use the same program.
    """
    with jax.default_device(device):
        return jnp.asarray(value, jnp.int32)


def place(tree: PyTree, device: Device) -> PyTree:
    """Return the tree with its arrays on a device.

    They are committed to the device, so that all attempts of a call of `plan` share compiled
    programs. On the default device arrays stay as they are, since it takes time to commit them.
    """
    default = jax.config.jax_default_device or jax.local_devices()[0]  # type: ignore[attr-defined]
    here, is_default = {device}, device == default

    def is_there(leaf: Array | np.ndarray) -> bool:
        if not isinstance(leaf, Array) or leaf.devices() != here:
            return False
        return is_default or leaf.committed

    if all(map(is_there, jax.tree.leaves(tree))):
        return tree
    return jax.device_put(tree, None if is_default else device)


# XLA would try its own kernels for every matrix product, which takes a third of the compile time
# on a GPU, while cuBLAS is as fast for these products. On a CPU the option has no effect.
COMPILER_OPTIONS: Options = {"xla_gpu_enable_triton_gemm": False}
# With `QUICK_OPTIONS` programs compile some seconds faster, but batches, and loops over cases, run
# about 10 % longer. For batches of up to `FEW` cases the options save time.
FEW = 256


def solve_cases(
    planner: Planner, cases: PyTree, loaded: PyTree, before: Score | None = None
) -> PyTree:
    """Return the plans of one case, or of a batch with a leading axis on every leaf; pure.

    `loaded` is an attempt (settings of a search) from `Planner.load_attempt`. All compiled programs
    call this function. Cases with an invalid number, such as NaN, get the status `BAD_INPUT`.
    `before` has the numbers of plans of earlier attempts, for planners that use them.
    """
    require_shapes(cases)
    attempt = loaded.attempt if isinstance(loaded, Fixed) else loaded
    solve: Callable = planner.solve if cases.batch_shape == () else planner.solve_lanes
    plans = solve(cases, attempt) if before is None else solve(cases, attempt, before)
    return mark_bad_input(plans, cases)


def score_of(attempt: BaseAttempt, cases: PyTree, plans: PyTree) -> Score | None:
    """Return the numbers of earlier plans (None: there are none) that an attempt needs, or None."""
    if not attempt.continues:
        return None
    if plans is not None:
        return Score.of(plans)
    return Score.none(cases.batch_shape, jax.dtypes.canonicalize_dtype(float_type(cases)))


def solve_on_device(
    planner: Planner,
    attempt: BaseAttempt,
    device: Device,
    cases: PyTree,
    before: Score | None = None,
    *,
    compiles_quickly: bool = False,
) -> tuple[PyTree, Array]:
    """Return plans of all cases, and the number () of unsolved cases.

    `before` has the numbers of earlier plans, see `score_of`. With `compiles_quickly`, compilation
    is faster and large batches take about 10 % longer.
    """
    run = _solve_quickly if compiles_quickly and QUICK_OPTIONS else _solve_fast
    return run(device.platform, None, *planner.load(attempt, cases), (cases, before))


def _solve_and_count(
    _: None, planner: Planner, loaded: PyTree, lanes: tuple[PyTree, Score | None]
) -> tuple[PyTree, Array]:
    return with_unsolved(solve_cases(planner, lanes[0], loaded, lanes[1]))


_solve_fast = Stored(_solve_and_count, COMPILER_OPTIONS)
_solve_quickly = Stored(_solve_and_count, COMPILER_OPTIONS | QUICK_OPTIONS)


def with_unsolved(plans: PyTree) -> tuple[PyTree, Array]:
    """Return the plans, and the number () of unsolved plans among them."""
    return plans, jnp.sum(is_unsolved(plans.status))


# Keys of the programs of `solve_on_device` that have been compiled.
compiled: set[Hashable] = set()


def program_key(
    planner: Planner,
    attempt: BaseAttempt,
    num: int,
    cases: PyTree,
    device: Device,
    compiles_quickly: bool,
) -> Hashable:
    """Return the key of the program that solves `num` cases on a device, for `compiled`."""
    own = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(planner))
    lanes = tuple((leaf.shape[1:], leaf.dtype) for leaf in jax.tree.leaves(cases))
    tree = jax.tree.structure((*planner.load(attempt, cases), cases))
    return tree, own, lanes, num, device, compiles_quickly, settings()


def solve_one(
    planner: Planner, case: PyTree, attempt: BaseAttempt, before: PyTree = None
) -> PyTree:
    """Return the plan of one case in NumPy arrays; the case is sent to the device as one vector.

    `before` is the best plan of earlier attempts, or None.
    """
    own = planner.load(attempt, case)
    quickly = planner.compiles_quickly(attempt)
    lane = case, score_of(attempt, case, before)
    return call_packed(_solve_one, None, own, lane, compiles_quickly=quickly)


def _solve_one(_: None, own: PyTree, lane: tuple[PyTree, Score | None]) -> PyTree:
    planner, loaded = own
    return solve_cases(planner, lane[0], loaded, lane[1])


def call_packed(
    function: Callable,
    static: Hashable,
    own: PyTree,
    case: PyTree,
    *,
    compiles_quickly: bool = False,
) -> PyTree:
    """Return `function(static, own, case)` in NumPy arrays; the case is sent as one vector.

    The pure function is compiled once for each hashable `static` and each layout of the other
    arguments. `own` is a pytree that stays on the device, such as a planner. `case` has NumPy
    leaves, at least one of them of a floating-point type. With `compiles_quickly`, options of XLA
    shorten the compilation.
    """
    leaves, tree = jax.tree.flatten(case)
    arrays = [np.asarray(leaf) for leaf in leaves]
    kept, own_tree = jax.tree.flatten(own)
    layouts = tuple(map(jax.typeof, kept)), tuple([(each.shape, each.dtype) for each in arrays])
    program = _program(function, static, own_tree, tree, *layouts, compiles_quickly, settings())
    pieces = [array.ravel() for array in arrays]
    vector = np.concatenate(pieces, dtype=program.dtype, casting="unsafe")
    packed = np.asarray(program.run(*kept, vector))
    found = [packed[where].reshape(shape) for where, shape in program.fields]
    for k, dtype in program.others:
        found[k] = found[k].astype(dtype)
    return jax.tree.unflatten(program.results.tree, found)


@dataclasses.dataclass(frozen=True)
class _Program:
    """A compiled function of arrays on the device and a packed vector; it returns a vector."""

    run: Callable[..., Array]
    dtype: np.dtype  # type of the input and output vectors
    results: Results

    @functools.cached_property
    def fields(self) -> list[tuple[slice, tuple[int, ...]]]:
        stops = np.cumsum([math.prod(shape) for shape in self.results.shapes]).tolist()
        starts = [0, *stops[:-1]]
        return list(zip(map(slice, starts, stops), self.results.shapes, strict=True))

    @functools.cached_property
    def others(self) -> list[tuple[int, np.dtype]]:
        return [(k, each) for k, each in enumerate(self.results.dtypes) if each != self.dtype]


@functools.cache
def _program(
    function: Callable,
    static: Hashable,
    own_tree: PyTree,
    tree: PyTree,
    own: Layout,
    layout: Sequence[tuple[tuple[int, ...], np.dtype]],
    compiles_quickly: bool,
    _: tuple,
) -> _Program:
    canonical = jax.dtypes.canonicalize_dtype
    dtype = canonical(np.result_type(*[d for _, d in layout if np.issubdtype(d, np.floating)]))
    ends = np.cumsum([math.prod(shape) for shape, _ in layout])
    results = Results()

    def run(*arrays: Array) -> Array:
        *kept, vector = arrays
        leaves = [
            piece.reshape(shape).astype(canonical(kind))
            for piece, (shape, kind) in zip(jnp.split(vector, ends[:-1]), layout, strict=True)
        ]
        stays = jax.tree.unflatten(own_tree, kept)
        found = function(static, stays, jax.tree.unflatten(tree, leaves))
        return jnp.concatenate([leaf.ravel().astype(dtype) for leaf in results.flatten(found)])

    options = QUICK_OPTIONS if compiles_quickly else None
    shapes = *own, jax.ShapeDtypeStruct((int(ends[-1]),), dtype)
    identity = function, static, own_tree, tree, layout
    platform = jax.default_backend()
    compiled = load_or_trace(run, shapes, identity, results, platform, options)
    return _Program(compiled, dtype, results)
