"""Sizes to which arrays of cases are padded, so that many cases share a compiled program."""

import numpy as np

from planner_jax.core.arithmetic import Numbers, numpy_of


def next_size(num: int, sizes: tuple[int, ...]) -> int:
    """Return the first of ascending `sizes` that is at least `num`, or `num` if it exceeds all."""
    return next((size for size in sizes if size >= num), num)


def resize(
    leaf: Numbers, axis: int, size: int, fill: Numbers | float | bool | None = 0.0
) -> Numbers:
    """Return an array of which one axis has the length `size`: cut off, or padded at its end.

    Args:
        leaf: NumPy or jax array.
        axis: negative number of the axis, so that it is the same for one case and for a batch.
        size: new length of the axis.
        fill: value of the added entries, which is broadcast to them. None repeats the last entry,
            of which there must be one.
    """
    at = leaf.ndim + axis
    num, before = leaf.shape[at], (slice(None),) * at
    if size <= num:
        return leaf if size == num else leaf[(*before, slice(size))]
    xp = numpy_of(leaf)
    last = leaf[(*before, slice(num - 1, num))] if fill is None else xp.asarray(fill, leaf.dtype)
    added = xp.broadcast_to(last, (*leaf.shape[:at], size - num, *leaf.shape[at + 1 :]))
    return xp.concatenate([leaf, added], axis=at)


def on_host(leaf: Numbers, batch: tuple[int, ...]) -> Numbers:
    """Return an array of one case as a NumPy array, and an array of a batch as it is."""
    return leaf if batch else np.asarray(leaf)
