"""`over_lanes` returns the same as `jax.vmap` with the batch axis last, for any function."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec

from planner_jax.lanes import kernels, over_lanes, with_kernel

MATRIX = np.random.default_rng(0).standard_normal((5, 4))
LANES = 32  # enough for a kernel


@jax.custom_jvp
def cube(x):
    return x**3


cube.defjvp(lambda primals, tangents: (cube(*primals), 7.0 * tangents[0]))  # not its slope


FUNCTIONS = {
    "matrix from the left": lambda x, k: MATRIX @ x,
    "matrix from the right": lambda x, k: x.T @ MATRIX.T,
    "matrix of three axes": lambda x, k: jnp.einsum("abc,bd->dac", MATRIX.reshape(5, 2, 2), x[:2]),
    "product of two lanes": lambda x, k: x.T @ x,
    "sum over axes": lambda x, k: (jnp.sum(x), jnp.sum(x, axis=-1), jnp.max(x, axis=0)),
    "shape": lambda x, k: x.reshape(2, 6)[::-1, 1::2].T,
    "joining": lambda x, k: jnp.concatenate([x, jnp.stack([x[0], jnp.ones(3)])], axis=0),
    "padding": lambda x, k: jnp.pad(x, ((1, 0), (0, 2)), constant_values=2.0),
    "splitting": lambda x, k: jnp.split(x, 3, axis=-1),
    "window": lambda x, k: jax.lax.dynamic_slice_in_dim(x, k, 2),
    "window across": lambda x, k: jax.lax.dynamic_slice(x, (0, k), (4, 2)),
    "window of a constant": lambda x, k: jax.lax.dynamic_slice_in_dim(MATRIX, k, 3) * x[0, 0],
    "gather": lambda x, k: x[k],
    "bounds": lambda x, k: jnp.clip(x, -0.5, x[0, 0]),
    "choice": lambda x, k: jnp.where(k > 1, x, 0.0),
    "loop": lambda x, k: jax.lax.while_loop(lambda y: jnp.sum(y**2) > 0.1, lambda y: 0.5 * y, x),
    "branches": lambda x, k: jax.lax.cond(k > 1, jnp.sin, jnp.cos, x),
    "own derivative": lambda x, k: (cube(x), jax.grad(lambda y: jnp.sum(cube(y)))(x)),
    "gradient": lambda x, k: jax.grad(lambda y: jnp.sum(jnp.sin(MATRIX @ y) ** 2) / y[0, 0])(x),
    "inner map": lambda x, k: jax.vmap(lambda a: jnp.sum(a * x))(jnp.arange(3.0)),
    "no lanes": lambda x, k: jnp.arange(3.0) + MATRIX[0, 0],
    "untouched": lambda x, k: {"k": k, "x": x},
    "compiled": lambda x, k: jax.jit(jnp.cumsum)(x),
    "order": lambda x, k: (jnp.argmin(x, axis=1), jnp.sort(x, axis=0)),
}


def lanes():
    random = np.random.default_rng(1)
    x = jnp.asarray(random.standard_normal((4, 3, LANES)))
    return x, jnp.asarray(random.integers(-1, 5, LANES))


@functools.cache
def by_vmap(name):
    return jax.jit(jax.vmap(FUNCTIONS[name], in_axes=-1, out_axes=-1))(*lanes())


@pytest.mark.parametrize("name", FUNCTIONS)
def test_it_equals_vmap_with_the_lanes_last(name, float64):
    expected, found = by_vmap(name), jax.jit(over_lanes(FUNCTIONS[name]))(*lanes())
    chex.assert_trees_all_equal_shapes_and_dtypes(found, expected)
    chex.assert_trees_all_close(found, expected, rtol=1e-12, atol=1e-14)


def test_a_shared_matrix_makes_one_product_and_no_gather():
    function = over_lanes(lambda x: jnp.sum((MATRIX @ x) ** 2))
    jaxpr = jax.make_jaxpr(function)(jnp.ones((4, 3, LANES)))
    (product,) = [eqn for eqn in jaxpr.eqns if eqn.primitive.name == "dot_general"]
    assert product.outvars[0].aval.shape == (5, 3, LANES)
    assert not [eqn for eqn in jaxpr.eqns if eqn.primitive.name in ("transpose", "gather")]


def test_lanes_do_not_mix():
    x, function = np.array(lanes()[0]), over_lanes(lambda y: jnp.tanh(MATRIX @ y))
    clean = function(jnp.asarray(x))
    x[:, :, 2] = np.nan
    broken = np.asarray(function(jnp.asarray(x)))
    assert np.isnan(broken[..., 2]).all()
    np.testing.assert_array_equal(np.delete(broken, 2, -1), np.delete(np.asarray(clean), 2, -1))


def test_a_program_for_several_devices_calls_the_kernel_and_gives_the_results_of_one(monkeypatch):
    calls = []

    def chosen(x, y):
        return jnp.sum(jnp.where(jnp.isfinite(x), x, jnp.inf)) + y

    def kernel(treedef, leaves):
        calls.append(treedef)
        return [jax.vmap(chosen, -1, -1)(*leaves)]

    monkeypatch.setattr(kernels, "has_gpu", lambda: True)
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *x, cuda, default: cuda(*x))
    monkeypatch.setattr(f"{__name__}.chosen_kernel", lambda: kernel, raising=False)
    attached = with_kernel(chosen, f"{__name__}:chosen_kernel")
    x, y = jnp.arange(3.0 * 16).reshape(3, 16), jnp.arange(16.0)
    mapped = over_lanes(lambda x, y: attached(x, jnp.where(y > 2.0, y, 0.0)))
    spec = PartitionSpec(None, "lanes"), PartitionSpec("lanes")
    mesh = Mesh(np.array(jax.devices()[:1]), ("lanes",))
    spread = jax.shard_map(mapped, mesh=mesh, in_specs=spec, out_specs=spec[1], check_vma=False)
    np.testing.assert_array_equal(spread(x, y), mapped(x, y))
    assert len(calls) == 2
