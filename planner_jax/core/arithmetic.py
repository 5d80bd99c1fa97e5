"""Arithmetic in forms that XLA compiles to few loops on a CPU.

The computing time of one small problem depends on the number of loops, and XLA compiles each
division, root or sum over an axis to its own loop.
"""

from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer
from numpy.typing import DTypeLike


def host_leaf(value: object, dtype: DTypeLike | None = None) -> Array:
    """Return a value as a NumPy array, which type checkers take for a jax `Array`."""
    return np.asarray(value, dtype)  # type: ignore[return-value]


Numbers = Array | np.ndarray


def numpy_of(*arrays: object) -> ModuleType:
    """Return `jax.numpy` if one of the arrays is a jax array, otherwise `numpy`."""
    return jnp if any(isinstance(each, jax.Array) for each in arrays) else np


def to_host(value: object) -> Numbers:
    """Return a value as a NumPy array; a traced array, which has no values yet, is unchanged.

    `numpy_of` of such arrays is thus `jax.numpy` only if one of them is traced.
    """
    return value if isinstance(value, Tracer) else np.asarray(value)


def float_type(tree: object) -> np.dtype:
    """Return the type of the first array of floating-point numbers in a pytree."""
    leaves = (x if hasattr(x, "dtype") else np.asarray(x) for x in jax.tree.leaves(tree))
    return next(leaf.dtype for leaf in leaves if leaf.dtype.kind == "f")


@jax.custom_jvp
def reciprocal(x: Array) -> Array:
    """Return 1 / x for x (...) != 0; the derivative needs no second division."""
    return 1.0 / x


@reciprocal.defjvp
def _reciprocal_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    y = reciprocal(*primals)
    return y, -y * y * tangents[0]


@jax.custom_jvp
def inverse_sqrt(x: Array) -> Array:
    """Return 1 / sqrt(x) for x (...) > 0; the derivative needs no second root."""
    return lax.rsqrt(jnp.asarray(x))


@inverse_sqrt.defjvp
def _inverse_sqrt_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    y = inverse_sqrt(*primals)
    return y, -0.5 * y * y * y * tangents[0]


def at_least(x: Array, floor: float) -> Array:
    """Return max(x, floor) with slope 1 at x == floor, where `jnp.maximum` has the slope 1/2."""
    return jnp.where(x < floor, floor, x)


Components = Array | tuple[Array, Array, Array]  # (..., 3), or its three components, each (...)


def components(x: Components) -> list[Array]:
    """Return the components (...) of vectors (..., n); a tuple `x` already holds these arrays."""
    if isinstance(x, tuple):
        return [*x]
    return [jnp.squeeze(part, -1) for part in jnp.split(x, x.shape[-1], axis=-1)]
