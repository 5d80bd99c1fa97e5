"""Comparisons of pytrees, leaf by leaf."""

import jax
import numpy as np


def assert_same(ours, theirs, lanes=...):
    """Assert that all leaves have equal types and, at some lanes, equal bits."""
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(np.asarray(a)[lanes], np.asarray(b)[lanes])
