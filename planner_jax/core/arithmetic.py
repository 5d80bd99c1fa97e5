"""Arithmetic in the forms that compile to few loops on a CPU.

XLA compiles a division, a root or a sum into a loop of its own, and one small problem waits
for the number of loops, not for what they compute.
"""

from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import DTypeLike


def host_leaf(value: object, dtype: DTypeLike | None = None) -> Array:
    """Return a value as a NumPy array that is a leaf of a case or plan, typed as its other leaves.

    Leaves are jax arrays inside compiled programs and may be NumPy arrays outside.
    """
    return np.asarray(value, dtype)  # type: ignore[return-value]


Numbers = Array | np.ndarray


def numpy_of(*arrays: object) -> ModuleType:
    """Return `jax.numpy` if one of the arrays is a jax array, otherwise `numpy`."""
    return jnp if any(isinstance(each, jax.Array) for each in arrays) else np


@jax.custom_jvp
def reciprocal(x: Array) -> Array:
    """1 / x for x (...) other than zero."""
    return 1.0 / x


@reciprocal.defjvp
def _reciprocal_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    y = reciprocal(*primals)
    return y, -y * y * tangents[0]


@jax.custom_jvp
def inverse_sqrt(x: Array) -> Array:
    """1 / sqrt(x) for x (...) > 0."""
    return lax.rsqrt(jnp.asarray(x))


@inverse_sqrt.defjvp
def _inverse_sqrt_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    y = inverse_sqrt(*primals)
    return y, -0.5 * y * y * y * tangents[0]


def at_least(x: Array, floor: float) -> Array:
    """The larger of x (...) and a constant; at a tie the slope is one.

    The slope of `jnp.maximum` divides by the number of arguments that tie.
    """
    return jnp.where(x < floor, floor, x)


Components = Array | tuple[Array, Array, Array]  # (..., 3), or its three components, each (...)


def components(x: Components) -> list[Array]:
    """The n components of vectors (..., n), each (...); a tuple of them is what it is.

    As one split, whose derivative is one concatenation and not n paddings to be added.
    """
    if isinstance(x, tuple):
        return [*x]
    return [jnp.squeeze(part, -1) for part in jnp.split(x, x.shape[-1], axis=-1)]
