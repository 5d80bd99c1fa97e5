"""Conversions and comparisons of pytrees, leaf by leaf."""

import jax
import numpy as np


def as_numpy(tree):
    return jax.tree.map(np.asarray, tree)


def assert_same(ours, theirs, lanes=...):
    """Assert that arrays of two pytrees have equal types, and equal values at indices `lanes`."""
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(np.asarray(a)[lanes], np.asarray(b)[lanes])
