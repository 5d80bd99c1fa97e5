"""Arguments of what makes a case, as arrays of one case or of a batch."""

import zlib
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.checks import numbers_of, shape_of
from planner_jax.core.choices import require_memory, require_size
from planner_jax.core.errors import ArgumentError

_DRAWN_BYTES = 1_000  # of a case, as estimated


def array_of(
    name: str, value: Any, batch: tuple[int, ...], shape: tuple[int, ...], dtype: Any
) -> Array:
    """`numbers_of`, as a jax array of a type."""
    with np.errstate(over="ignore"):  # what is too large is infinite, and refused as that
        return jnp.asarray(numbers_of(name, value, batch, shape), dtype)


def batch_of(name: str, vectors: Any, *shape: int) -> tuple[int, ...]:
    """The batch's axes of an argument (..., *shape), which the others follow.

    Raises:
        TypeError: no numbers.
        ValueError: the argument does not end with this shape.
    """
    given = shape_of(name, vectors)
    if given[len(given) - len(shape) :] != shape or len(given) < len(shape):
        ends = ", ".join(map(str, shape))
        raise ArgumentError(name, f"a shape that ends with ({ends},)", given, verb="have")
    return given[: len(given) - len(shape)]


def require_draw(num: Any, seed: Any, first: Any) -> None:
    """Raise unless so many cases of a suite can be drawn from a seed, from a place on.

    Raises:
        TypeError: one of them is no whole number.
        ValueError: one of them is too small, or `num` is more than memory holds.
    """
    for name, value, least in (("num", num, 1), ("seed", seed, 0), ("first", first, 0)):
        require_size(name, value, least)
    require_memory("num", num, _DRAWN_BYTES)


def make_generators(suite: str, num: int, seed: int, first: int) -> list[np.random.Generator]:
    """Make a generator for every case of a suite, so that no case depends on the others.

    Raises:
        TypeError, ValueError: as of `require_draw`.
    """
    require_draw(num, seed, first)
    tag = zlib.crc32(suite.encode())
    return [np.random.default_rng([seed, first + k, tag]) for k in range(num)]
