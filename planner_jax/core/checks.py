"""What single arguments must be: a number, a whole number, a switch, an array, one of a class.

Each check raises one line, `NAME must be RULE, got VALUE`: `TypeError` for another kind of value,
`ValueError` for one that breaks the rule.
"""

import functools
import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from planner_jax.core.errors import ArgumentError, ArgumentTypeError


def shapes_told(tree: Any) -> str:
    """Names and shapes of the leaves of a pytree in one line, for a message."""
    parts = jax.tree_util.tree_leaves_with_path(tree)
    names = (jax.tree_util.keystr(place, simple=True, separator=".") for place, _ in parts)
    return ", ".join(f"{n} {np.shape(leaf)}" for n, (_, leaf) in zip(names, parts, strict=True))


def require_number(
    name: str,
    value: Any,
    words: str = "finite",
    holds: Callable[[Any], Any] = lambda value: True,
) -> None:
    """Raise unless an argument is one finite number that keeps a rule.

    Args:
        name: of the argument.
        value: it may be an array of no axes. Of what is traced, and of jax arrays, which may lie
            on another device, only shape and kind are looked at.
        words: of the rule, the finiteness included.
        holds: whether a finite number keeps the rule.
    """
    require_scalar(name, value)
    if not isinstance(value, jax.Array) and not (np.isfinite(value) and holds(value)):
        raise ArgumentError(name, words, value)


def require_scalar(name: str, value: Any) -> None:
    """Raise `TypeError` unless an argument is one number, finite or not."""
    number = numeric(value)
    if number is None or number.shape or number.dtype == np.bool_:
        raise ArgumentTypeError(name, "a number", value)


def require_switch(name: str, value: Any) -> None:
    """Raise `TypeError` unless an argument is true or false."""
    if not isinstance(value, bool | np.bool_):
        raise ArgumentTypeError(name, "True or False", value)


def require_kind(name: str, value: Any, *kinds: type) -> None:
    """Raise `TypeError` unless an argument is of a class, or of one of some."""
    if not isinstance(value, kinds):
        known = " or a ".join(kind.__name__ for kind in kinds)
        raise ArgumentTypeError(name, f"a {known}", shown=f"a {type(value).__name__}")


def require_path_name(name: str, value: Any) -> None:
    """Raise `TypeError` unless an argument may be the path of a file."""
    if not isinstance(value, str | os.PathLike):
        raise ArgumentTypeError(name, "the path of a file", value)


_HOSTS = (np.ndarray, np.generic, float)  # kinds that are told from JAX's arrays at once


def numeric(value: Any) -> Any:
    """Real numbers as an array, NumPy's unless it is traced or one of jax; None of all else."""
    try:
        is_ours = isinstance(value, _HOSTS) or not isinstance(value, Tracer | jax.Array)
        array: Any = np.asarray(value) if is_ours else value
    except ValueError:  # rows of different lengths
        return None
    if array.dtype.kind in "biuf" or jnp.issubdtype(array.dtype, jnp.floating):
        return array
    return None


def numbers_of(name: str, value: Any, batch: tuple[int, ...], shape: tuple[int, ...]) -> np.ndarray:
    """A number or vector that all cases of a batch share, or one for each, batch + shape.

    Args:
        name: of the argument, for the message.
        value: of the shape, or with the batch's axes in front; no other shape, lest an axis be
            stretched by accident.
        batch: () or (B,).
        shape: of one case.

    Raises:
        ValueError: another shape.
        TypeError: no numbers.
    """
    given = numeric(value)
    if given is None:
        raise ArgumentTypeError(name, "numbers", value)
    given, whole = np.asarray(given), (*batch, *shape)
    if given.shape not in (shape, whole):
        rule = f"{shape}" if whole == shape else f"{shape} or {whole}"
        raise ArgumentError(name, f"the shape {rule}", given.shape, verb="have")
    return given if given.shape == whole else np.broadcast_to(given, whole)


def shape_of(name: str, value: Any) -> tuple[int, ...]:
    """The shape of an argument that holds numbers; raises `TypeError` where it does not."""
    given = numeric(value)
    if given is None:
        raise ArgumentTypeError(name, "numbers", value)
    return given.shape


def floating(dtype: Any) -> Any:
    """A type of floating-point numbers that JAX has switched on.

    Raises:
        TypeError: another type, or float64 while JAX computes in float32.
    """
    try:
        kind = np.dtype(dtype)
    except TypeError:
        kind = None
    if kind is None or not jnp.issubdtype(kind, np.floating):
        raise ArgumentTypeError("dtype", "a type of floating-point numbers", dtype)
    if jax.dtypes.canonicalize_dtype(kind) != kind:
        raise ArgumentTypeError("dtype", "float32 unless jax_enable_x64 is set", kind)
    return kind


def require_beginning(name: str, tree: Any, shape: tuple[int, ...], words: str) -> None:
    """Raise unless every leaf of an argument begins with a shape, and there is one.

    Args:
        name: of the argument, for the message.
        tree: the argument, a pytree of arrays.
        shape: with which the shapes of its leaves begin.
        words: for that shape, for the message.

    Raises:
        TypeError: there is no leaf, or one that is no array of numbers.
        ValueError: a leaf begins with another shape.
    """
    _arrays_beginning(name, tree, shape, words)


def _arrays_beginning(
    name: str, tree: Any, shape: tuple[int, ...], words: str
) -> tuple[list[Any], Any]:
    """The leaves as arrays, and the tree's structure; raises as `require_beginning`."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [numeric(leaf) for leaf in leaves]
    if not arrays or any(array is None for array in arrays):
        raise ArgumentTypeError(name, "arrays of numbers", tree, verb="hold")
    for array in arrays:
        if array.shape[: len(shape)] != shape:
            raise ArgumentError(name, f"leaves that begin with {words}", array.shape, verb="have")
    return arrays, structure


def require_path(
    name: str, path: Any, axes: tuple[int, ...], dimensions: int, whose: str = ""
) -> None:
    """Raise unless an argument is a target's path, or an array of them.

    Args:
        name: of the argument, for the message.
        path: a pytree with a method `at(time)`.
        axes: that its leaves have in front of those of one path.
        dimensions: of the positions, 2 or 3.
        whose: the argument that has decided about the axes, for the message.

    Raises:
        TypeError: it has no such method, or no positions come of it.
        ValueError: it has other axes.
    """
    if isinstance(path, type) or not callable(getattr(path, "at", None)):
        raise ArgumentTypeError(name, "a path, with a method at(time)", path)
    of = f" of {whose}" if whose else ""
    arrays, tree = _arrays_beginning(name, path, axes, f"the shape {axes}{of}")
    layout = tuple([(array.shape, array.dtype) for array in arrays])
    try:
        found = _shape_of_positions(tree, layout, axes)
    except (TypeError, ValueError, IndexError, AttributeError) as error:
        rule = f"a path of which at(time) gives a position, with the axes {axes}{of}"
        found = f"a {type(path).__name__} with {shapes_told(path)}"
        raise ArgumentTypeError(name, rule, shown=found) from error
    if found != (*axes, dimensions):
        rule = f"the shape {(*axes, dimensions)}"
        raise ArgumentError(name, f"positions of {rule}", verb="give", shown=found)


@functools.lru_cache(maxsize=256)
def _shape_of_positions(tree: Any, layout: tuple, axes: tuple[int, ...]) -> tuple[int, ...]:
    """The shape of what paths say at a time; kept, since it takes a millisecond to find out."""
    # A path may say its position alone.
    at: Any = lambda one, time: getattr(found := one.at(time), "pos", found)  # noqa: E731
    for _ in axes:
        at = jax.vmap(at)
    kinds = [(shape, jax.dtypes.canonicalize_dtype(dtype)) for shape, dtype in layout]
    path = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*each) for each in kinds])
    return jax.eval_shape(at, path, jax.ShapeDtypeStruct(axes, np.float32)).shape
