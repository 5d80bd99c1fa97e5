"""Runtime checks of arguments and results against type and shape annotations, for tests."""

import functools
import inspect
import typing
from collections.abc import Sequence

import jax
import jaxtyping
import numpy as np
import numpy.typing as npt
from beartype import BeartypeConf, FrozenDict, beartype
from beartype.roar import BeartypeDecorHintException

# Packages of `planner_jax` whose functions are checked while tests run.
PACKAGES = (
    *("core", "lanes", "ball", "trajectory", "robot", "space", "plane"),
    *("cost", "penalties", "optimise", "perception", "planning"),
)
is_on = True  # False for tests of the library's own checks, which take arguments of any type
# What an argument annotated as `jax.Array` may be: a JAX or NumPy array, a number, or a
# `ShapeDtypeStruct` of `jax.eval_shape`. Arguments annotated as numbers may be NumPy's.
_LEAF = jax.typing.ArrayLike | jax.ShapeDtypeStruct
_HINTS = {jax.Array: _LEAF, int: int | np.integer, float: float | int | np.floating}
# NumPy's protocol of sequences in `ArrayLike` has a method that tuples lack, `__reversed__`.
_PARTS = [each for each in typing.get_args(npt.ArrayLike) if typing.get_origin(each)]
_SEQUENCES = [each for each in _PARTS if "_NestedSequence" in str(each)]
_HINTS |= dict.fromkeys(_SEQUENCES, Sequence)
if not _PARTS:  # later versions of NumPy name the union by a statement `type`
    _HINTS[npt.ArrayLike] = _LEAF | Sequence
_check = beartype(conf=BeartypeConf(hint_overrides=FrozenDict(_HINTS)))
_subscript = type(jaxtyping.Float).__getitem__


def accept_leaves() -> None:
    """Make annotations such as `Float[Array, "n 3"]` accept NumPy arrays and numbers, too."""

    def subscript(cls, item):
        array, shape = item
        return _subscript(cls, (_LEAF if array is jax.Array else array, shape))

    type(jaxtyping.Float).__getitem__ = subscript


def check(function):
    """Return the function with checks of its arguments and its result against its annotations.

    Constructors are not checked, because JAX builds pytrees of objects of any type. Functions with
    annotations that cannot be checked at run time, such as `Self`, are returned unchanged.
    """
    if function.__name__ == "__init__":
        return function
    if not inspect.isfunction(function):  # a class, whose methods are checked one by one
        return _add_checks(function)
    checked = None

    @functools.wraps(function)
    def call(*args, **kwargs):
        nonlocal checked
        if checked is None:  # functions that no test calls get no checks, which takes time
            checked = _add_checks(function)
        return (checked if is_on else function)(*args, **kwargs)

    return call


def _add_checks(function):
    try:
        return _check(function)
    except BeartypeDecorHintException:
        return function
