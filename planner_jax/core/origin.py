"""Positions relative to the origin of a case, which float32 represents exactly enough anywhere.

The function `case` of hits and catches subtracts the origin from all positions in float64, before
they are rounded to float32. Planners and referees then compute near (0, 0). Samples, exports and
`replan` add or subtract the origin in float64 on the host.
"""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar, TypeVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.core import Tracer
from jax.typing import DTypeLike
from jaxtyping import PyTree

from planner_jax.core.arithmetic import Numbers, numpy_of, to_host
from planner_jax.core.checks import numbers_of, numeric
from planner_jax.core.errors import ArgumentError
from planner_jax.core.rules import Rule

TreeT = TypeVar("TreeT")

_DIGITS = -2  # origins are multiples of 100 m, which float32 represents exactly
ROUNDING = 1.2e-3  # [m], greatest rounding error of a position


def _is_near(state: Numbers, case: PyTree) -> Numbers:
    is_motion = np.arange(4).reshape(*(1,) * (state.ndim - 2), 4, 1) > 0
    return (abs(state) * jnp.finfo(state.dtype).eps <= ROUNDING) | is_motion


# Of a state (4, 3), the position in float32 must be within 10 km of the origin. In float64 the
# bound is 5e9 km.
NEAR = Rule("within 10 km of the case's origin in float32", _is_near)


@struct.dataclass
class Located:
    """A case or a plan, or a batch, whose positions are relative to an origin in the world.

    Attributes:
        origin: (2,) [m], x and y of the origin in the world; None: (0, 0).
    """

    positions: ClassVar[dict] = {}  # for `move`, of the arguments of `replan`

    origin: Array | None = struct.field(default=None, kw_only=True)


def find_origin(
    start: object, origin: object, batch: tuple[int, ...], dtype: DTypeLike
) -> Numbers | None:
    """Return the origin (2,) float64 [m] of a case or batch; None for (0, 0).

    By default it is the multiple of 100 m next to the first position `start`, and None if `start`
    is traced. A traced `origin` is never None, since it has no values yet.
    """
    if 0 in batch:
        raise ArgumentError("cases", "at least one", shown=f"the batch shape {batch}")
    first = numbers_of("start", start, batch, (3,)).reshape(-1, 3)[0, :2].astype(float)
    if origin is not None:
        first = numbers_of("origin", origin, (), (2,)).astype(float)
    if isinstance(first, Tracer):
        return None if origin is None else first
    if origin is not None:
        if not (first == first.astype(dtype)).all():
            rule = f"exact in {np.dtype(dtype)}, such as a multiple of 100 m"
            raise ArgumentError("origin", rule, origin)
    elif np.isfinite(first).all():
        first = np.round(first, _DIGITS)
    return first if np.isfinite(first).all() and first.any() else None


def move(
    name: str,
    value: PyTree,
    by: Numbers | None,
    dtype: DTypeLike,
    index: tuple[int, ...] = (),
    *,
    is_strict: bool = False,
) -> PyTree:
    """Return positions moved by the vectors `by` (..., 2) [m], added in float64; None: unchanged.

    Traced float32 positions are moved in float32. Where they have been rounded by over 1 mm, they
    become NaN, which leads to the status `BAD_INPUT`.

    Args:
        name: name of the argument, for errors.
        value: array of positions (..., 3), or an object whose class has `positions`: a dict of the
            names of its fields with positions, and the index of the position in each of them.
        by: (2,), or (B, 2) for a batch whose axis the positions have.
        dtype: type of the moved positions.
        index: index of the position in the array, such as (0,) in a state (4, 3).
        is_strict: whether an object without `positions` is an error; otherwise it is not moved.

    Raises:
        ArgumentError: a class has no `positions`, or the positions have been rounded by over 1 mm.
    """
    if by is None:
        return value
    if isinstance(value, Sequence) and value and dataclasses.is_dataclass(value[0]):
        args = by, dtype, index
        return tuple(
            move(f"{name}.{k}", each, *args, is_strict=is_strict) for k, each in enumerate(value)
        )
    if dataclasses.is_dataclass(value):
        fields = getattr(type(value), "positions", None)
        if fields is None and not is_strict:
            return value
        if fields is None:
            rule = "of a class with `positions`, or relative to the argument origin"
            raise ArgumentError(name, rule, shown=f"a {type(value).__name__}")
        new = {
            field: move(f"{name}.{field}", vars(value)[field], by, dtype, at)
            for field, at in fields.items()
        }
        return dataclasses.replace(value, **new)  # type: ignore[type-var]
    array, axes = numeric(value), by.shape[:-1]
    if array is None or array.shape[-1:] != (3,) or array.shape[: len(axes)] != axes:
        return value  # the caller's checks name the argument
    array = to_host(array)
    moved = _add(array, by, index)
    if array.dtype.kind == "f":
        eps = float(jnp.finfo(array.dtype).eps)
        if isinstance(array, Tracer):
            moved = jnp.where(eps * abs(array) > ROUNDING, jnp.nan, moved)
        elif (rounding := eps * np.abs(array).max(initial=0.0)) > ROUNDING:
            rule = f"in float64 NumPy arrays, as {array.dtype} rounds them by {rounding:.2g} m"
            raise ArgumentError(name, rule, shown="")
    return jnp.asarray(moved.astype(dtype))


def _add(values: Numbers, by: Numbers, index: tuple[int, ...] = ()) -> Numbers:
    place = (..., *index, slice(by.shape[-1]))
    moved = numpy_of(values, by).asarray(values).astype(float)
    by = by.reshape(by.shape[:-1] + (1,) * (moved[place].ndim - by.ndim) + by.shape[-1:])
    if isinstance(moved, np.ndarray):
        moved[place] += by
        return moved
    return moved.at[place].add(by)


def to_world(positions: Numbers, origin: Numbers | None) -> PyTree:
    """Return positions (..., 3) plus the origin (2,) or (B, 2) in float64; None: unchanged."""
    if origin is None:
        return positions
    return _add(to_host(positions), to_host(origin).astype(float))


def without_origin(tree: TreeT) -> TreeT:
    """Return a case or plan without its origin, so that all origins share compiled programs."""
    if isinstance(tree, Located) and tree.origin is not None:
        return dataclasses.replace(tree, origin=None)
    return tree


def with_origin(plans: TreeT, cases: object) -> TreeT:
    """Return plans with the origin of their cases."""
    if isinstance(plans, Located) and isinstance(cases, Located) and cases.origin is not None:
        return dataclasses.replace(plans, origin=cases.origin)
    return plans


def split_far(positions: PyTree) -> tuple[PyTree, np.ndarray | None]:
    """Return float64 NumPy positions minus a multiple of 100 m (2,) near the first, and it.

    Positions within 1 km of the origin, and in other arrays, are returned unchanged, with None.
    """
    if not isinstance(positions, np.ndarray) or positions.dtype != np.float64:
        return positions, None
    by = np.round(positions.reshape(-1, positions.shape[-1])[0, :2], _DIGITS)
    is_far = np.isfinite(by).all() and np.abs(by).max() > 1000.0
    return (_add(positions, -by), by) if is_far else (positions, None)


def has_origin(plans: object, cases: object) -> bool:
    """Return whether plans and cases have the same origin; classes without `Located` do."""
    if not (isinstance(plans, Located) and isinstance(cases, Located)):
        return True
    ours, theirs = (np.zeros(2) if x.origin is None else x.origin for x in (plans, cases))
    return np.array_equal(ours, theirs)
