"""The compiled programs: one attempt at one case, or at the lanes of all devices.

One case is sent as one vector, and its plan comes back as one: each array that crosses into or out
of a compiled program costs some microseconds, a good part of the time of a plan of one case.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import PyTree

from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt, is_unsolved, marked
from planner_jax.core.rules import require_shapes
from planner_jax.planning.layout import LANES, apart

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
    return marked(plans, cases)


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
