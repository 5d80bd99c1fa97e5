"""Checks of targets' paths, and of trees whose arrays have the axes of a batch."""

import functools
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from planner_jax.core.arithmetic import Numbers
from planner_jax.core.checks import format_shapes, numeric
from planner_jax.core.errors import ArgumentError, ArgumentTypeError


def require_beginning(name: str, tree: PyTree, shape: tuple[int, ...], words: str) -> list[Numbers]:
    """Return a pytree's leaves as arrays; raise unless the shape of each begins with `shape`.

    `words` describe the required shape in the error's text.
    """
    leaves = jax.tree.leaves(tree)
    arrays = [array for leaf in leaves if (array := numeric(leaf)) is not None]
    if not arrays or len(arrays) < len(leaves):
        raise ArgumentTypeError(name, "arrays of numbers", tree, verb="hold")
    for array in arrays:
        if array.shape[: len(shape)] != shape:
            raise ArgumentError(name, f"leaves that begin with {words}", array.shape, verb="have")
    return arrays


@runtime_checkable
class _Path(Protocol):
    """The position of a target as a function of time, in two or three dimensions."""

    def at(self, time: Numbers, /) -> PyTree:
        """Return the position at a time [s], or an object whose attribute `pos` is the position."""
        ...


def require_path(
    name: str, path: object, axes: tuple[int, ...], dimensions: int, whose: str = ""
) -> bool:
    """Raise unless an argument is a target's path, or an array of paths.

    Return whether the path's method `at(time)` returns the position alone, without velocity.

    Args:
        name: name of the argument.
        path: a pytree with a method `at(time)`.
        axes: batch axes that every array of `path` has in front of the axes of one path.
        dimensions: dimension of the positions, 2 or 3.
        whose: name of the argument that determines `axes`, for the message.
    """
    if isinstance(path, type) or not isinstance(path, _Path):
        raise ArgumentTypeError(name, "a path, with a method at(time)", path)
    of = f" of {whose}" if whose else ""
    arrays = require_beginning(name, path, axes, f"the shape {axes}{of}")
    layout = tuple([(array.shape[len(axes) :], array.dtype) for array in arrays])
    try:
        position, is_bare = _shape_of_position(jax.tree.structure(path), layout)
    except (TypeError, ValueError, IndexError, AttributeError) as error:
        rule = f"a path whose at(time) returns a position, with the axes {axes}{of}"
        shown = f"a {type(path).__name__} with {format_shapes(path)}"
        raise ArgumentTypeError(name, rule, shown=shown) from error
    if position != (dimensions,):
        rule = f"positions of the shape {(*axes, dimensions)}"
        raise ArgumentError(name, rule, (*axes, *position), verb="return")
    return is_bare


@functools.lru_cache(maxsize=256)
def _shape_of_position(tree: PyTree, layout: tuple) -> tuple[tuple[int, ...], bool]:
    kinds = [(shape, jax.dtypes.canonicalize_dtype(dtype)) for shape, dtype in layout]
    path = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*each) for each in kinds])
    floating = (dtype for _, dtype in kinds if jnp.issubdtype(dtype, np.floating))
    time = jax.ShapeDtypeStruct((), next(floating, np.float32))
    state = jax.eval_shape(lambda path, time: path.at(time), path, time)
    pos = getattr(state, "pos", state)  # `at` may return the position alone
    return pos.shape, pos is state
