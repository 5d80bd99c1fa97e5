"""Sizes to which arrays of cases are padded, so that many cases share a compiled program."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.core.arithmetic import Numbers
from planner_jax.core.compiled import has_only_cpu
from planner_jax.core.protocol import is_resident
from planner_jax.core.rules import Case

CaseT = TypeVar("CaseT", bound=Case)


def next_size(num: int, sizes: tuple[int, ...]) -> int:
    """Return the first of ascending `sizes` that is at least `num`, or `num` if it exceeds all."""
    return next((size for size in sizes if size >= num), num)


def resize(
    leaf: Numbers, axis: int, size: int, fill: Numbers | float | bool | None = 0.0
) -> Numbers:
    """Cut or pad an array at the end of one axis, so that the axis has the length `size`.

    Args:
        leaf: NumPy or jax array.
        axis: negative number of the axis, so that it is the same for one case and for a batch.
        size: new length of the axis.
        fill: value of the added entries, which is broadcast to them. None repeats the last entry
            of an axis that is not empty.
    """
    num = leaf.shape[axis]
    if num == size:
        return leaf
    before = (slice(None),) * (leaf.ndim + axis)
    if size < num:
        return leaf[(*before, slice(size))]
    shape, last = list(leaf.shape), (*before, slice(num - 1, num))
    shape[axis] = size
    fill = leaf[last] if fill is None else fill
    if isinstance(leaf, np.ndarray):  # assignments take less time than NumPy's concatenation
        found = np.empty(shape, leaf.dtype)
        found[(*before, slice(num))] = leaf
        found[(*before, slice(num, None))] = fill
        return found
    shape[axis] = size - num
    added = jnp.broadcast_to(jnp.asarray(fill, leaf.dtype), shape)
    return jnp.concatenate([leaf, added], axis=axis)


def on_host(leaf: Numbers, batch: tuple[int, ...]) -> Numbers:
    """Return an array of one case as a NumPy array, and an array of a batch as it is."""
    return leaf if batch else np.asarray(leaf)


def fit_resident(fit: Callable[[CaseT], CaseT], cases: CaseT) -> CaseT:
    """Return `fit(cases)`; NumPy pads a batch in jax arrays on CPUs, which compiles nothing.

    The batch stays in jax arrays on its devices. A case alone may become NumPy arrays.
    """
    first = jax.tree.leaves(cases)[0]
    is_kept = cases.batch_shape and has_only_cpu() and is_resident(cases)
    if not is_kept or not first.is_fully_addressable:
        return fit(cases)
    found = fit(jax.tree.map(np.asarray, cases))
    if len(first.sharding.device_set) == 1:
        return jax.tree.map(jnp.asarray, found)
    return jax.device_put(found, first.sharding)
