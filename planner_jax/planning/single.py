"""One plan at a time: an attempt compiled from vector to vector."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.planning.batch import solve_cases
from planner_jax.protocol import Attempt, Planner, is_solved, is_unsolved

_Layout = tuple[tuple[tuple[int, ...], Any], ...]  # shapes and dtypes of a tree's leaves


def plan_single(planner: Planner, attempts: Sequence[Attempt], case: Any) -> Any:
    """Attempts at one case until one of them solves it."""
    best = None
    for attempt in attempts:
        plan = _solve_single(planner, attempt, case)
        if best is None or is_solved(int(plan.status)) or plan.violation < best.violation:
            best = plan
        if not is_unsolved(int(best.status)):
            break
    return best


def _solve_single(planner: Planner, attempt: Attempt, case: Any) -> Any:
    """One attempt at one case, its leaves sent and fetched as one vector.

    Each array that crosses into or out of a compiled program costs some microseconds, which
    for one plan would add up to a fifth of the time.
    """
    leaves, treedef = jax.tree.flatten(case)
    arrays = [np.asarray(leaf) for leaf in leaves]
    own, planner_tree = jax.tree.flatten(planner)
    solver = _packed_solver(planner_tree, _layout(own), attempt, treedef, _layout(arrays))
    vector = np.concatenate(
        [array.ravel() for array in arrays], dtype=solver.dtype, casting="unsafe"
    )
    packed = np.asarray(solver.solve(own, vector))
    return jax.tree.unflatten(
        solver.plan_tree,
        [
            packed[where].reshape(shape).astype(dtype, copy=False)
            for where, shape, dtype in solver.fields
        ],
    )


def _layout(leaves: Sequence[Any]) -> _Layout:
    return tuple([(leaf.shape, leaf.dtype) for leaf in leaves])


@dataclasses.dataclass(frozen=True)
class _PackedSolver:
    """A compiled attempt, from the planner's leaves and a vector to a vector."""

    solve: Callable[[list[Any], np.ndarray], jax.Array]
    dtype: np.dtype  # of both vectors
    plan_tree: Any
    fields: list[tuple[slice, tuple[int, ...], Any]]  # where the plan's leaves lie


@functools.cache
def _packed_solver(
    planner_tree: Any, own: _Layout, attempt: Attempt, treedef: Any, layout: _Layout
) -> _PackedSolver:
    """The solver for planners and cases of these trees, shapes and dtypes."""
    floating = [kind for _, kind in layout if np.issubdtype(kind, np.floating)]
    dtype = jax.dtypes.canonicalize_dtype(np.result_type(*floating))
    ends = np.cumsum([math.prod(shape) for shape, _ in layout])

    def unpacked(own: list[Any], vector: jax.Array) -> Any:
        pieces = jnp.split(vector, ends[:-1])
        shaped = [
            piece.reshape(shape).astype(kind)
            for piece, (shape, kind) in zip(pieces, layout, strict=True)
        ]
        planner = jax.tree.unflatten(planner_tree, own)
        return solve_cases(planner, jax.tree.unflatten(treedef, shaped), attempt)

    def packed(own: list[Any], vector: jax.Array) -> jax.Array:
        leaves = jax.tree.leaves(unpacked(own, vector))
        return jnp.concatenate([leaf.ravel().astype(dtype) for leaf in leaves])

    shapes = jax.eval_shape(
        unpacked,
        [jax.ShapeDtypeStruct(shape, kind) for shape, kind in own],
        jax.ShapeDtypeStruct((int(ends[-1]),), dtype),
    )
    leaves, plan_tree = jax.tree.flatten(shapes)
    stops = np.cumsum([leaf.size for leaf in leaves]).tolist()
    fields = [
        (slice(stop - leaf.size, stop), leaf.shape, leaf.dtype)
        for stop, leaf in zip(stops, leaves, strict=True)
    ]
    return _PackedSolver(jax.jit(packed), dtype, plan_tree, fields)
