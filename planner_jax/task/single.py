"""One plan at a time: a round compiled from vector to vector."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.optimise.multistart import solve_round
from planner_jax.optimise.problem import Planner, Round, Scenario
from planner_jax.optimise.status import is_solved, is_unsolved


def plan_single(planner: Planner, scenario: Scenario) -> Any:
    """The planner's rounds on one case until one of them solves it."""
    best = None
    for attempt in planner.rounds:
        found = _solve_single(planner, attempt, scenario)
        if best is None or is_solved(int(found.status)) or found.violation < best.violation:
            best = found
        if not is_unsolved(int(best.status)):
            break
    return best


def _solve_single(planner: Planner, attempt: Round, scenario: Scenario) -> Any:
    """One round on one case, its leaves sent and fetched as one vector.

    Each array that crosses into or out of a compiled program costs some microseconds, which
    for one plan would add up to a fifth of the time.
    """
    leaves, treedef = jax.tree.flatten(scenario)
    arrays = [np.asarray(leaf) for leaf in leaves]
    layout = tuple([(array.shape, array.dtype) for array in arrays])
    solver = _packed_solver(planner, attempt, treedef, layout)
    vector = np.concatenate(
        [array.ravel() for array in arrays], dtype=solver.dtype, casting="unsafe"
    )
    packed = np.asarray(solver.solve(vector))
    return jax.tree.unflatten(
        solver.plan_tree,
        [
            packed[where].reshape(shape).astype(dtype, copy=False)
            for where, shape, dtype in solver.fields
        ],
    )


@dataclasses.dataclass(frozen=True)
class _PackedSolver:
    """A compiled round from vector to vector."""

    solve: Callable[[np.ndarray], jax.Array]
    dtype: np.dtype  # of both vectors
    plan_tree: Any
    fields: list[tuple[slice, tuple[int, ...], Any]]  # where the plan's leaves lie


@functools.cache
def _packed_solver(
    planner: Planner, attempt: Round, treedef: Any, layout: tuple[tuple[tuple[int, ...], Any], ...]
) -> _PackedSolver:
    """The solver of scenarios with this tree and these shapes and dtypes of leaves."""
    floating = [kind for _, kind in layout if np.issubdtype(kind, np.floating)]
    dtype = jax.dtypes.canonicalize_dtype(np.result_type(*floating))
    ends = np.cumsum([math.prod(shape) for shape, _ in layout])

    def unpacked(vector: jax.Array) -> Any:
        pieces = jnp.split(vector, ends[:-1])
        shaped = [
            piece.reshape(shape).astype(kind)
            for piece, (shape, kind) in zip(pieces, layout, strict=True)
        ]
        return solve_round(planner, attempt, jax.tree.unflatten(treedef, shaped))

    def packed(vector: jax.Array) -> jax.Array:
        leaves = jax.tree.leaves(unpacked(vector))
        return jnp.concatenate([leaf.ravel().astype(dtype) for leaf in leaves])

    shapes = jax.eval_shape(unpacked, jax.ShapeDtypeStruct((int(ends[-1]),), dtype))
    leaves, plan_tree = jax.tree.flatten(shapes)
    stops = np.cumsum([leaf.size for leaf in leaves]).tolist()
    fields = [
        (slice(stop - leaf.size, stop), leaf.shape, leaf.dtype)
        for stop, leaf in zip(stops, leaves, strict=True)
    ]
    return _PackedSolver(jax.jit(packed), dtype, plan_tree, fields)
