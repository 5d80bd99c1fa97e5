"""Comparison of gradients by automatic differentiation with finite differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np


@functools.cache
def value_and_gradient(function):
    return jax.jit(jax.value_and_grad(function))


def assert_gradient_matches_differences(function, point, *, step=1e-5, rtol=1e-7, directions=3):
    """Assert that a scalar function's gradient agrees with central differences, in float64.

    Derivatives are compared along random directions d. `step` is relative to the size of each array
    of the pytree `point`, and `rtol` is relative to the sum of |g_i d_i| with the gradient g.
    """
    point = jax.tree.map(lambda x: np.asarray(x, np.float64), point)
    gradient = jax.tree.map(np.asarray, value_and_gradient(function)(point)[1])
    rng = np.random.default_rng(0)
    for _ in range(directions):
        sized = lambda x: np.max(np.abs(x), initial=0.1) * rng.normal(size=x.shape)  # noqa: E731
        direction = jax.tree.map(sized, point)
        ends = (along(point, direction, h) for h in (step, -step))
        ahead, behind = (float(value_and_gradient(function)(end)[0]) for end in ends)
        products = jax.tree.map(lambda g, d: np.ravel(g * d), gradient, direction)
        terms = np.concatenate(jax.tree.leaves(products))
        slope, atol = (ahead - behind) / (2.0 * step), rtol * np.sum(np.abs(terms))
        np.testing.assert_allclose(np.sum(terms), slope, rtol=0.0, atol=atol)


def double(tree):
    """Convert the floating-point leaves of a pytree to float64."""

    def convert(leaf):
        leaf = jnp.asarray(leaf)
        is_floating = jnp.issubdtype(leaf.dtype, jnp.floating)
        return leaf.astype(jnp.float64) if is_floating else leaf

    return jax.tree.map(convert, tree)


def along(point, direction, distance):
    return jax.tree.map(lambda x, d: x + distance * d, point, direction)
