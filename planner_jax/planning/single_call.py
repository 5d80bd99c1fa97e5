"""Compiled functions of one case, which is sent as one vector and answered by one.

Each array that crosses into or out of a compiled program costs some microseconds, which for a
decision or a plan of one case would add up to a good part of the time.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_Layout = tuple[tuple[tuple[int, ...], Any], ...]  # shapes and dtypes of a tree's leaves


def call_packed(function: Callable, static: Hashable, own: Any, case: Any) -> Any:
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
    vector = np.concatenate(
        [array.ravel() for array in arrays], dtype=program.dtype, casting="unsafe"
    )
    packed = np.asarray(program.run(kept, vector))
    result = program.result
    found = [packed[where].reshape(shape) for where, shape in result.fields]
    for k, dtype in result.others:
        found[k] = found[k].astype(dtype)
    return jax.tree.unflatten(result.tree, found)


def _layout(leaves: Sequence[Any]) -> _Layout:
    return tuple([(leaf.shape, leaf.dtype) for leaf in leaves])


@dataclasses.dataclass(frozen=True)
class _Result:
    """What lies where in a vector."""

    tree: Any
    fields: list[tuple[slice, tuple[int, ...]]]  # of the leaves: place and shape
    others: list[tuple[int, Any]]  # which leaves are of another dtype than the vector, and of which


@dataclasses.dataclass(frozen=True)
class _Program:
    """A compiled function, from what stays and a vector to a vector."""

    run: Callable[[list[Any], np.ndarray], jax.Array]
    dtype: np.dtype  # of both vectors
    examples: list[Any]  # one result of zeros, known as soon as the function has been traced

    @functools.cached_property
    def result(self) -> _Result:
        """Where its results lie in the vector."""
        leaves, tree = jax.tree.flatten(self.examples[0])
        stops = np.cumsum([leaf.size for leaf in leaves]).tolist()
        fields = [
            (slice(stop - leaf.size, stop), leaf.shape)
            for stop, leaf in zip(stops, leaves, strict=True)
        ]
        dtypes = enumerate(leaf.dtype for leaf in leaves)
        return _Result(tree, fields, [each for each in dtypes if each[1] != self.dtype])


@functools.cache
def _program(
    function: Callable,
    static: Hashable,
    own_tree: Any,
    own: _Layout,
    tree: Any,
    layout: _Layout,
) -> _Program:
    """Return the program for trees of these shapes and dtypes."""
    floating = [kind for _, kind in layout if np.issubdtype(kind, np.floating)]
    dtype = jax.dtypes.canonicalize_dtype(np.result_type(*floating))
    ends = np.cumsum([math.prod(shape) for shape, _ in layout])

    def unpacked(kept: list[Any], vector: jax.Array) -> Any:
        pieces = jnp.split(vector, ends[:-1])
        shaped = [
            piece.reshape(shape).astype(jax.dtypes.canonicalize_dtype(kind))
            for piece, (shape, kind) in zip(pieces, layout, strict=True)
        ]
        given = jax.tree.unflatten(own_tree, kept)
        return function(static, given, jax.tree.unflatten(tree, shaped))

    examples: list[Any] = []

    def packed(kept: list[Any], vector: jax.Array) -> jax.Array:
        result = unpacked(kept, vector)
        examples[:] = [jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), result)]
        return jnp.concatenate([leaf.ravel().astype(dtype) for leaf in jax.tree.leaves(result)])

    return _Program(jax.jit(packed), dtype, examples)
