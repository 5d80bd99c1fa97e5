"""Matrix products request full float32 precision, which a GPU does not use by default."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jaxpr import assert_full_precision

from planner_jax.trajectory import proportional_minco as minco

MATRIX, ROWS = np.eye(3, dtype=np.float32), np.ones((8, 3), np.float32)


def full(a, b):
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def custom_derivative(product):
    function = jax.custom_jvp(lambda a, b: product(a, b))
    function.defjvp(lambda primals, tangents: (product(*primals), product(*tangents)))
    return function


def proportional_values(rows, offsets, duration):
    maps = minco.proportional_minco(4, (1.0,) * 4)
    args = maps, rows, offsets, duration
    parts = minco.proportional_trajectory(*args), minco.trajectory_energy(*args)
    samples = minco.sample_motion(maps, 5, jnp.concatenate([rows, offsets]), duration)
    return sum(jnp.sum(leaf) for leaf in jax.tree.leaves((parts, samples)))


NESTED = {
    "plain": lambda product: product,
    "jit": jax.jit,
    "vmap": lambda product: lambda a, b: jax.vmap(product, in_axes=(None, 0))(a, b[None]),
    "loop": lambda product: lambda a, b: lax.scan(lambda c, _: (product(a, c), None), b, None, 2),
    "branch": lambda product: lambda a, b: lax.cond(a[0, 0] > 0, product, lambda a, b: b, a, b),
    "checkpoint": jax.checkpoint,
    "custom derivative": custom_derivative,
    "linear solve": lambda product: (
        lambda a, b: lax.custom_linear_solve(
            lambda x: product(a, x), b, lambda _, x: x, symmetric=True
        )
    ),
}


@pytest.mark.parametrize("nest", NESTED.values(), ids=NESTED)
def test_a_product_of_less_precision_is_found_in_any_nesting(nest):
    assert assert_full_precision(nest(full), MATRIX, MATRIX) > 0
    for precision in (None, lax.Precision.DEFAULT, lax.Precision.HIGH):
        less = lambda a, b, p=precision: jnp.matmul(a, b, precision=p)  # noqa: E731
        with pytest.raises(AssertionError, match="dot_general of .* asks for precision"):
            assert_full_precision(nest(less), MATRIX, MATRIX)


def test_the_equal_duration_maps_and_their_gradients_request_full_precision():
    given = ROWS, ROWS[:3], np.float32(0.4)
    assert assert_full_precision(proportional_values, *given) > 0
    assert assert_full_precision(jax.grad(proportional_values, argnums=(0, 1, 2)), *given) > 0
