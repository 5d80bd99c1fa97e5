"""Checks of the types and shapes that functions of the library annotate, while tests run."""

import functools
import inspect

import jax
import jaxtyping
import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype
from beartype.roar import BeartypeDecorHintException

# Packages whose functions are checked. `sims`, `policies` and the command line are not.
PACKAGES = (
    *("core", "lanes", "ball", "trajectory", "robot", "space", "plane"),
    *("cost", "optimise", "planning"),
)
is_on = True  # False for tests of the library's own checks, which take arguments of any type
# A leaf of a pytree is a NumPy array on the host, a shape where nothing is computed, and a number
# where a test or a constant says so. Numbers may be NumPy's.
_LEAF = jax.typing.ArrayLike | jax.ShapeDtypeStruct
_HINTS = {jax.Array: _LEAF, int: int | np.integer, float: float | int | np.floating}
_check = beartype(conf=BeartypeConf(hint_overrides=FrozenDict(_HINTS)))
_subscript = type(jaxtyping.Float).__getitem__


def accept_leaves() -> None:
    """Have annotations such as `Float[Array, "n 3"]` accept every leaf of their shape."""

    def subscript(cls, item):
        array, shape = item
        return _subscript(cls, (_LEAF if array is jax.Array else array, shape))

    type(jaxtyping.Float).__getitem__ = subscript


def check(function):
    """Return the function with checks of its arguments and its result.

    Constructors are not checked: JAX builds pytrees of anything. Annotations with `Self` or with a
    protocol that is not checkable at run time leave a function as it is.
    """
    if function.__name__ == "__init__":
        return function
    try:
        checked = _check(function)
    except BeartypeDecorHintException:
        return function
    if not inspect.isfunction(function):  # a class, whose methods are checked one by one
        return checked

    @functools.wraps(function)
    def call(*args, **kwargs):
        return (checked if is_on else function)(*args, **kwargs)

    return call
