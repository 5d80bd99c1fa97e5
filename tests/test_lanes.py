"""`over_lanes` is `jax.vmap` with the lanes last, whatever the function does."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec

from planner_jax.lanes import attach, in_one_kernel, over_lanes, pallas
from planner_jax.lanes.scalars import Unsupported, scalar_kernel

MATRIX = np.random.default_rng(0).standard_normal((5, 4))
LANES = 32  # what a kernel takes


@jax.custom_jvp
def cube(x):
    return x**3


cube.defjvp(lambda primals, tangents: (cube(*primals), 7.0 * tangents[0]))  # not its slope


def halved_until_small(x):
    return jax.lax.while_loop(lambda y: jnp.sum(y**2) > 0.1, lambda y: 0.5 * y, x)


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
    "loop": lambda x, k: halved_until_small(x),
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
    """What the functions are called with."""
    random = np.random.default_rng(1)
    x = jnp.asarray(random.standard_normal((4, 3, LANES)))
    return x, jnp.asarray(random.integers(-1, 5, LANES))


@functools.cache
def by_vmap(name):
    """What a function gives, in float64."""
    return jax.jit(jax.vmap(FUNCTIONS[name], in_axes=-1, out_axes=-1))(*lanes())


@pytest.mark.parametrize("name", FUNCTIONS)
def test_is_vmap_with_the_lanes_last(name, float64):
    expected, found = by_vmap(name), jax.jit(over_lanes(FUNCTIONS[name]))(*lanes())
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-14)


def test_a_shared_matrix_makes_one_product_and_no_gather():
    """What the layout is for: the lanes stay columns of one large product."""
    jaxpr = jax.make_jaxpr(over_lanes(lambda x: jnp.sum((MATRIX @ x) ** 2)))(
        jnp.ones((4, 3, LANES))
    )
    (product,) = [eqn for eqn in jaxpr.eqns if eqn.primitive.name == "dot_general"]
    assert product.outvars[0].aval.shape == (5, 3, LANES)
    assert not [eqn for eqn in jaxpr.eqns if eqn.primitive.name in ("transpose", "gather")]


def test_lanes_do_not_mix():
    x = np.random.default_rng(2).standard_normal((4, 3, LANES))
    clean = over_lanes(lambda y: jnp.tanh(MATRIX @ y))(jnp.asarray(x))
    x[:, :, 2] = np.nan
    broken = np.asarray(over_lanes(lambda y: jnp.tanh(MATRIX @ y))(jnp.asarray(x)))
    assert np.isnan(broken[..., 2]).all()
    np.testing.assert_array_equal(np.delete(broken, 2, -1), np.delete(np.asarray(clean), 2, -1))


# What a kernel of single operations does not do: loops, branches, sorting, and reading at a
# place of each lane's own from anything but an argument.
NOT_IN_A_KERNEL = {"loop", "branches", "order", "window of a constant"}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_kernel_of_single_operations_gives_the_same(name, float64):
    (x, k), function = lanes(), FUNCTIONS[name]
    closed = jax.make_jaxpr(lambda *args: jax.tree.leaves(function(*args)))(x[..., 0], k[0])
    if name in NOT_IN_A_KERNEL:
        with pytest.raises(Unsupported):
            scalar_kernel(closed, [x, k], 16, interpret=True)
        return
    found = jax.jit(lambda *args: scalar_kernel(closed, [*args], 16, interpret=True))(x, k)
    for ours, theirs in zip(found, jax.tree.leaves(by_vmap(name)), strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-14)


def test_a_kernel_does_nothing_twice_and_nothing_in_vain():
    def function(x):
        unused = jnp.cos(x)
        return jnp.sin(x[0]) * jnp.sin(x[0]) + 0.0 * unused.size

    kernel = functools.partial(scalar_kernel, threads=16, interpret=True)
    lanes = jnp.ones((2, 16), jnp.float32)
    closed = jax.make_jaxpr(function)(lanes[:, 0])
    jaxpr = str(jax.make_jaxpr(lambda lanes: kernel(closed, [lanes]))(lanes))
    assert jaxpr.count("= sin ") == 1
    assert jaxpr.count("= cos ") == 0


def test_axes_in_front_of_some_arguments_are_in_front_of_all_results():
    closed = jax.make_jaxpr(lambda x, k: (jnp.sum(x) * k, k + 1.0))(jnp.ones(3), jnp.ones(()))
    x = jnp.arange(2.0 * 3 * 16).reshape(2, 3, 16)
    k = jnp.arange(16.0)
    product, later = scalar_kernel(closed, [x, k], 16, interpret=True)
    np.testing.assert_allclose(product, x.sum(axis=1) * k)
    np.testing.assert_allclose(later, [k + 1.0, k + 1.0])


def test_arguments_that_all_lanes_share_are_constants():
    closed = jax.make_jaxpr(lambda x, c: c @ x)(jnp.ones(3), jnp.ones((2, 3)))
    x, shared = jnp.arange(3.0 * 16).reshape(3, 16), np.arange(6.0, dtype=np.float32).reshape(2, 3)
    np.testing.assert_allclose(
        scalar_kernel(closed, [x, shared], 16, interpret=True)[0], shared @ x, rtol=1e-6
    )


def test_a_function_that_would_take_long_to_compile_is_refused():
    closed = jax.make_jaxpr(lambda x: jnp.cumsum(jnp.sin(x)))(jnp.ones(500))
    with pytest.raises(Unsupported, match="too large"):
        scalar_kernel(closed, [jnp.ones((500, 16))], 16)


@pytest.fixture
def used(monkeypatch):
    """What kernels were made, as if there were a GPU: for each how many arguments it has."""
    made = []

    def interpreted(closed, args, threads):
        found = scalar_kernel(closed, args, threads, interpret=True)
        made.append(len(args))
        return found

    monkeypatch.setattr(attach, "scalar_kernel", interpreted)
    monkeypatch.setattr(pallas, "has_gpu", lambda: True)
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *x, cuda, default: cuda(*x))
    return made


def test_a_program_for_several_devices_has_the_kernels_of_one(used):
    """There `jnp.where` also says that a device's arrays are its own."""

    def chosen(x, y):
        return jnp.sum(jnp.where(jnp.isfinite(x), x, jnp.inf)) + y

    x, y = jnp.arange(3.0 * 16).reshape(3, 16), jnp.arange(16.0)
    mapped = over_lanes(lambda x, y: in_one_kernel(chosen)(x, jnp.where(y > 2.0, y, 0.0)))
    spec = PartitionSpec(None, "lanes"), PartitionSpec("lanes")
    mesh = Mesh(np.array(jax.devices()[:1]), ("lanes",))
    spread = jax.shard_map(mapped, mesh=mesh, in_specs=spec, out_specs=spec[1], check_vma=False)
    np.testing.assert_array_equal(spread(x, y), mapped(x, y))
    assert len(used) == 2


def test_halves_of_a_function_in_one_kernel_are_kernels(used, float64):
    """Values, `vmap` within a lane, slopes in both modes and the slope of a slope."""

    def plain(x, given):
        return {"y": jnp.sin(x) * given["k"], "z": jnp.sum(MATRIX @ x**3)}

    one = in_one_kernel(plain)

    def total(function, x, given):
        found = function(x, given)
        return jnp.sum(found["y"] ** 2) + found["z"]

    x = jnp.asarray(np.random.default_rng(3).standard_normal((4, 16)))
    given = {"k": jnp.linspace(0.5, 1.0, 16)}
    for number, asked in (
        (1, lambda f: lambda x, g: f(x, g)),
        (1, lambda f: lambda x, g: jax.vmap(lambda a: f(a * x, g))(jnp.arange(3.0))),
        (2, lambda f: jax.grad(lambda x, g: total(f, x, g))),
        (0, lambda f: jax.value_and_grad(lambda x, g: total(f, x, g), argnums=(0, 1))),
        (1, lambda f: lambda x, g: jax.jvp(lambda y: total(f, y, g), (x,), (jnp.ones(4),))[1]),
        (2, lambda f: jax.grad(lambda x, g: jnp.sum(jax.grad(lambda y: total(f, y, g))(x) ** 2))),
    ):
        used.clear()
        expected = jax.jit(jax.vmap(asked(plain), in_axes=-1, out_axes=-1))(x, given)
        found = jax.jit(over_lanes(asked(one)))(x, given)
        assert len(used) >= number and bool(used) == bool(number)
        for ours, theirs in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12)


def test_without_a_gpu_a_function_in_one_kernel_is_what_it_was(float64):
    function = FUNCTIONS["gradient"]
    x, k = jnp.ones((4, 3)), jnp.ones((), int)
    np.testing.assert_allclose(in_one_kernel(function)(x, k), function(x, k), rtol=1e-13)
