"""Checks of single arguments: numbers, switches, arrays, paths, instances of a class.

Each check raises an error of one line, `NAME must be RULE, got VALUE`: `ArgumentTypeError` for a
value of the wrong type, `ArgumentError` for a value that breaks the rule. NAME is the argument
`name` of the check.
"""

import os

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import PyTree

from planner_jax.core.arithmetic import Numbers, numpy_of, to_host
from planner_jax.core.errors import ArgumentError, ArgumentTypeError, NotOffered
from planner_jax.core.rules import FINITE, Rule


def format_shapes(tree: PyTree) -> str:
    """Return one line with the names and shapes of the arrays in a pytree."""
    parts = jax.tree_util.tree_leaves_with_path(tree)
    names = (jax.tree_util.keystr(place, simple=True, separator=".") for place, _ in parts)
    return ", ".join(f"{n} {np.shape(leaf)}" for n, (_, leaf) in zip(names, parts, strict=True))


def require_number(name: str, value: object, rule: Rule = FINITE) -> None:
    """Raise unless `value` is a finite number that keeps `rule`; jax scalars may have any value."""
    number = require_scalar(name, value)
    if not isinstance(number, jax.Array) and not all(r.holds(number, None) for r in (FINITE, rule)):
        words = rule.words if rule is FINITE else f"{FINITE.words} and {rule.words}"
        raise ArgumentError(name, words, value)


def require_scalar(name: str, value: object) -> Numbers:
    """Return a number, finite or not, as an array (); raise `ArgumentTypeError` for all else."""
    number = numeric(value)
    if number is None or number.shape or number.dtype == np.bool_:
        raise ArgumentTypeError(name, "a number", value)
    return number


def require_switch(name: str, value: object) -> None:
    """Raise `ArgumentTypeError` unless an argument is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise ArgumentTypeError(name, "True or False", value)


def require_numbers(name: str, value: object) -> None:
    """Raise `ArgumentTypeError` unless an argument is a tuple of numbers."""
    numbers = [numeric(each) for each in value] if isinstance(value, tuple) else [None]
    if any(each is None or each.shape for each in numbers):
        raise ArgumentTypeError(name, "a tuple of numbers", value)


def require_kind(name: str, value: object, *kinds: type) -> None:
    """Raise `ArgumentTypeError` unless an argument is an instance of one of the classes."""
    if not isinstance(value, kinds):
        known = " or a ".join(kind.__name__ for kind in kinds)
        raise ArgumentTypeError(name, f"a {known}", shown=f"a {type(value).__name__}")


def require_values(call: str, *trees: PyTree) -> None:
    """Raise `TypeError` if trees, arguments of a function of the host, have traced arrays."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees)):
        raise NotOffered(f"{call} works on the host: call it outside your compiled function")


def require_path_name(name: str, value: object) -> None:
    """Raise `ArgumentTypeError` unless an argument can be the path of a file."""
    if not isinstance(value, str | os.PathLike):
        raise ArgumentTypeError(name, "the path of a file", value)


# Types of values that are not jax arrays. `numeric` tests for them first, since the test is fast.
_HOSTS = (np.ndarray, np.generic, float)


def numeric(value: object) -> Numbers | None:
    """Return numbers or bools as an array, jax arrays unchanged; None if the value is neither.

    A list or tuple with traced numbers becomes a traced array. An array with masked entries is
    neither, since its masked numbers would count like others.
    """
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        return None
    try:
        is_jax = not isinstance(value, _HOSTS) and isinstance(value, Tracer | jax.Array)
        array: Numbers = value if is_jax else np.asarray(value)  # type: ignore[assignment]
    except jax.errors.TracerArrayConversionError:  # a list or tuple with traced numbers
        try:
            array = jnp.asarray(value)
        except (TypeError, ValueError):
            return None
    except ValueError:  # rows of different lengths
        return None
    if getattr(array.dtype, "kind", "O") in "biuf" or jnp.issubdtype(array.dtype, jnp.floating):
        return array
    return None


def numbers_of(name: str, value: object, batch: tuple[int, ...], shape: tuple[int, ...]) -> Numbers:
    """Return numbers for every case of a batch, as an array of the shape batch + shape.

    It is a traced array if the argument is traced, otherwise a NumPy array. The argument has this
    shape, or the shape `shape` for numbers that all cases share. Other shapes raise, so that no
    axis is broadcast by accident. `batch` is () for one case, (B,) for B cases.
    """
    array, whole = to_host(require_numeric(name, value)), (*batch, *shape)
    if array.shape not in (shape, whole):
        rule = f"{shape}" if whole == shape else f"{shape} or {whole}"
        raise ArgumentError(name, f"the shape {rule}", array.shape, verb="have")
    return array if array.shape == whole else numpy_of(array).broadcast_to(array, whole)


def shape_of(name: str, value: object) -> tuple[int, ...]:
    """Return the shape of an argument; raise `ArgumentTypeError` unless it holds numbers."""
    return require_numeric(name, value).shape


def require_numeric(name: str, value: object) -> Numbers:
    """Return numbers as an array; raise `ArgumentTypeError` for all else."""
    array = numeric(value)
    if array is None:
        raise ArgumentTypeError(name, "numbers", value)
    return array


def floating(dtype: object) -> np.dtype:
    """Return `dtype` if it is a floating-point type that JAX has enabled, or raise an error."""
    try:
        kind = np.dtype(dtype)  # type: ignore[call-overload]
    except (TypeError, ValueError):
        kind = None
    if kind is None or not jnp.issubdtype(kind, np.floating):
        raise ArgumentTypeError("dtype", "a type of floating-point numbers", dtype)
    if jax.dtypes.canonicalize_dtype(kind) != kind:
        raise ArgumentTypeError("dtype", "float32 unless jax_enable_x64 is set", kind)
    return kind
