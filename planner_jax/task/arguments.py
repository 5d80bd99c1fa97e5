"""Arguments of what makes a case, as arrays of one case or of a batch."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.memory import require_memory

_DRAWN_BYTES = 1_000  # of a case, as estimated


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
    given = np.asarray(value)
    if given.dtype.kind not in "biuf" and not jnp.issubdtype(given.dtype, np.floating):
        raise TypeError(f"{name} must be numbers, got {value!r:.60}")
    whole = (*batch, *shape)
    if given.shape not in (shape, whole):
        rule = f"{shape}" if whole == shape else f"{shape} or {whole}"
        raise ValueError(f"{name} must have the shape {rule}, got {given.shape}")
    return np.broadcast_to(given, whole)


def array_of(
    name: str, value: Any, batch: tuple[int, ...], shape: tuple[int, ...], dtype: Any
) -> Array:
    """`numbers_of`, as a jax array of a type."""
    with np.errstate(over="ignore"):  # what is too large is infinite, and refused as that
        return jnp.asarray(numbers_of(name, value, batch, shape), dtype)


def batch_of(name: str, vectors: Any, *shape: int) -> tuple[int, ...]:
    """The batch's axes of an argument (..., *shape), which the others follow.

    Raises:
        ValueError: the argument does not end with this shape.
    """
    given = np.shape(vectors)
    if given[len(given) - len(shape) :] != shape or len(given) < len(shape):
        ends = ", ".join(map(str, shape))
        raise ValueError(f"{name} must have a shape that ends with ({ends},), got {given}")
    return given[: len(given) - len(shape)]


def require_beginning(name: str, tree: Any, shape: tuple[int, ...], words: str) -> None:
    """Raise `ValueError` unless every leaf of an argument begins with a shape.

    Args:
        name: of the argument, for the message.
        tree: the argument, a pytree.
        shape: with which the shapes of its leaves begin.
        words: for that shape, for the message.
    """
    for leaf in jax.tree.leaves(tree):
        if np.shape(leaf)[: len(shape)] != shape:
            raise ValueError(
                f"{name} must have leaves that begin with {words}, got {np.shape(leaf)}"
            )


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
        raise TypeError(f"dtype must be a type of floating-point numbers, got {dtype!r:.60}")
    if jax.dtypes.canonicalize_dtype(kind) != kind:
        raise TypeError(f"dtype must be float32 unless jax_enable_x64 is set, got {kind}")
    return kind


def require_draw(num: Any, seed: Any, first: Any) -> None:
    """Raise unless so many cases of a suite can be drawn from a seed, from a place on.

    Raises:
        TypeError: one of them is no whole number.
        ValueError: one of them is too small, or `num` is more than memory holds.
    """
    for name, value, least in (("num", num, 1), ("seed", seed, 0), ("first", first, 0)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            raise TypeError(f"{name} must be a whole number, got {value!r:.60}")
        if value < least:
            raise ValueError(f"{name} must be >= {least}, got {value}")
        if value >= 2**63:
            raise ValueError(f"{name} must be < 2**63, got {value}")
    require_memory("num", num, _DRAWN_BYTES)
