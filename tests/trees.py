"""Conversions and comparisons of pytrees."""

import chex
import jax
import numpy as np


def as_numpy(tree):
    return jax.tree.map(np.asarray, tree)


def assert_same(ours, theirs, lanes=...):
    """Assert that pytrees have equal structures, shapes and types, and values at `lanes`."""
    ours, theirs = (jax.tree.map(lambda leaf: np.asarray(leaf)[lanes], x) for x in (ours, theirs))
    chex.assert_trees_all_equal(ours, theirs, strict=True)
