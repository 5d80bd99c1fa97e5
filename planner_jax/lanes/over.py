"""`over_lanes`: it works as `jax.vmap`, but keeps the batch axis last in every array.

A lane is one problem of the batch. With the lanes last, a number is stored next to the same number
of the next lane. Neighbouring GPU threads, one for each lane, then read neighbouring addresses, a
sum over samples needs no exchange between threads, and multiplying by a constant matrix is one
large product.
"""

import functools
from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Var

from planner_jax.core.compiled import traced_platform
from planner_jax.lanes import kernels
from planner_jax.lanes.kernels import shape_of

Results = TypeVar("Results")

_CALLS = frozenset(
    "checkpoint closed_call core_call custom_jvp_call custom_vjp_call jit pjit remat2".split()
)
# Operations that return their operands unchanged. In a program for several devices `reshard` marks
# arrays as local to a device. The arrays of one lane (problem) are local already.
_UNCHANGED = frozenset("copy copy_p reshard stop_gradient".split())
_ELEMENTWISE = frozenset(
    "abs acos add add_any and asin atan atan2 cbrt ceil clamp convert_element_type "
    "cos cosh div eq erf exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p logistic "
    "lt max min mul ne neg not or pow reduce_precision rem round rsqrt select_n sign sin sinh "
    "sqrt square sub tan tanh xor".split()
)
# Operations whose parameters number axes from the front, and stay valid with one more last axis.
_BY_AXIS = frozenset(
    "argmax argmin cumlogsumexp cummax cummin cumprod cumsum reduce_and reduce_max reduce_min "
    "reduce_or reduce_prod reduce_sum rev sort split squeeze unstack concatenate stack".split()
)


class _Lanes:
    """An array whose last axis runs over the lanes, which are the problems of the batch."""

    def __init__(self, array: Array) -> None:
        self.array = array


_Value = Any  # `_Lanes`, or an array or a number that is the same for all lanes


def over_lanes(function: Callable[..., Results]) -> Callable[..., Results]:
    """Map a function of one lane (problem of a batch) over many lanes at once.

    Args:
        function: takes pytrees of arrays of ONE lane, and returns a pytree of arrays.

    Returns:
        A function of the same pytrees with the lanes as one more, last, axis on every leaf. Up to
        rounding it equals `jax.vmap` with all axes -1. Call it inside a compiled function. If
        `function` has custom derivatives, differentiate only within `function`.
    """

    @functools.wraps(function)
    def map_lanes(*args: object) -> Results:
        leaves, treedef = jax.tree.flatten(args)
        lanes = leaves[0].shape[-1]
        single = [jax.ShapeDtypeStruct(leaf.shape[:-1], leaf.dtype) for leaf in leaves]
        operands = jax.tree.unflatten(treedef, single)
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*operands)
        return jax.tree.unflatten(jax.tree.structure(shape), _full_results(closed, leaves, lanes))

    return map_lanes


def _widen(value: _Value, shape: tuple[int, ...], lanes: int) -> Array:
    """Return a value as an array (*shape, lanes); repeat it if all lanes (problems) share it."""
    if isinstance(value, _Lanes):
        return value.array
    return _repeat(jnp.asarray(value), (*shape, lanes), range(len(shape)))


def _full_results(closed: ClosedJaxpr, leaves: Sequence[Array], lanes: int) -> list[Array]:
    values = _evaluate(closed, [_Lanes(leaf) for leaf in leaves], lanes, {})
    pairs = zip(values, closed.jaxpr.outvars, strict=True)
    return [_widen(value, shape_of(out), lanes) for value, out in pairs]


def _evaluate(
    closed: ClosedJaxpr, args: Sequence[_Value], lanes: int, constants: dict[Hashable, Array]
) -> list[_Value]:
    """Evaluate a jaxpr; `constants` are the repeated literals that the program has already."""
    jaxpr = closed.jaxpr
    values: dict[Var, _Value] = dict(zip(jaxpr.constvars, closed.consts, strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))

    def read(atom: Var | Literal) -> _Value:
        return atom.val if isinstance(atom, Literal) else values[atom]

    for eqn in jaxpr.eqns:
        inputs = [read(atom) for atom in eqn.invars]
        is_unchanged = eqn.primitive.name in _UNCHANGED
        outputs = inputs if is_unchanged else _outputs(eqn, inputs, lanes, constants)
        values.update(zip(eqn.outvars, outputs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _outputs(
    eqn: JaxprEqn, inputs: list[_Value], lanes: int, constants: dict[Hashable, Array]
) -> list[_Value]:
    name = eqn.primitive.name
    if name in _CALLS:
        inner = eqn.params["jaxpr"] if "jaxpr" in eqn.params else eqn.params["call_jaxpr"]
        closed = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
        kernel = kernels.kernel_of(eqn) if kernels.in_use() else None
        if kernel is None:
            return _evaluate(closed, inputs, lanes, constants)
        return _by_kernel(eqn, closed, kernel, inputs, lanes)
    if not any(isinstance(value, _Lanes) for value in inputs):
        return _bind(eqn, inputs)
    arrays = None
    if name in _ELEMENTWISE:
        out_shape = shape_of(eqn.outvars[0])
        pairs = zip(inputs, eqn.invars, strict=True)
        arrays = _bind(
            eqn, [_spread_once(value, atom, out_shape, lanes, constants) for value, atom in pairs]
        )
    elif name in _BY_AXIS:
        pairs = zip(inputs, eqn.invars, strict=True)
        arrays = _bind(eqn, [_widen(value, shape_of(atom), lanes) for value, atom in pairs])
    elif name in _RULES:
        arrays = _RULES[name](eqn, inputs, lanes)
    if arrays is None:
        arrays = _by_vmap(eqn, inputs)
    return [_Lanes(array) for array in arrays]


def _by_kernel(
    eqn: JaxprEqn, closed: ClosedJaxpr, kernel: kernels.Kernel, inputs: list[_Value], lanes: int
) -> list[_Value]:
    """Evaluate a call of a function that has a kernel: by the kernel on a GPU, else without it."""
    pairs = zip(inputs, eqn.invars, strict=True)
    arrays = [_widen(value, shape_of(atom), lanes) for value, atom in pairs]
    shapes = [(*shape_of(atom), lanes) for atom in eqn.outvars]

    def by_operations(*leaves: Array) -> list[Array]:
        return _full_results(closed, leaves, lanes)

    def in_kernel(*leaves: Array) -> list[Array]:
        results = kernel(leaves)
        if results is None:
            return by_operations(*leaves)
        # A `vmap` within a lane adds a leading axis to all results of the kernel. Where a result is
        # constant along this axis, the call's result lacks the axis, and the first entry is taken.
        pairs = zip(results, shapes, strict=True)
        results = [result[(0,) * (result.ndim - len(shape))] for result, shape in pairs]
        as_called = all(r.shape == shape for r, shape in zip(results, shapes, strict=True))
        return results if as_called else by_operations(*leaves)

    platform = traced_platform()
    if platform is None:
        results = lax.platform_dependent(*arrays, cuda=in_kernel, default=by_operations)
    else:
        results = (by_operations if platform == "cpu" else in_kernel)(*arrays)
    return [_Lanes(leaf) for leaf in results]


def _bind(eqn: JaxprEqn, inputs: Sequence[_Value], **changes: object) -> list[Array]:
    results = eqn.primitive.bind(*inputs, **{**eqn.params, **changes})
    return list(results) if eqn.primitive.multiple_results else [results]


def _spread_once(
    value: _Value,
    atom: Var | Literal,
    shape: tuple[int, ...],
    lanes: int,
    constants: dict[Hashable, Array],
) -> Array:
    """Return a value as an array (*shape, lanes); a literal is repeated only once."""
    if not isinstance(atom, Literal) or np.ndim(atom.val):
        return _spread(value, shape, lanes)
    key = str(np.asarray(atom.val)), atom.aval.dtype, shape  # type: ignore[attr-defined]
    if key not in constants:
        constants[key] = _spread(value, shape, lanes)
    return constants[key]


def _spread(value: _Value, shape: tuple[int, ...], lanes: int) -> Array:
    whole = (*shape, lanes)
    if not isinstance(value, _Lanes):
        array = jnp.asarray(value)
        return _repeat(array, whole, range(array.ndim))
    if value.array.ndim == 1:  # one number for each lane, such as the bound of a clamp
        return _repeat(value.array, whole, (len(shape),))
    return _repeat(value.array, whole, range(len(whole)))


def _repeat(array: Array, shape: tuple[int, ...], axes: Sequence[int]) -> Array:
    """Repeat an array to a shape, in which its own axes are `axes`."""
    return array if array.shape == shape else lax.broadcast_in_dim(array, shape, tuple(axes))


def _by_vmap(eqn: JaxprEqn, inputs: list[_Value]) -> list[Array]:
    """Evaluate any operation by `jax.vmap`, with the lanes (problems) moved to the first axis."""
    arrays = [jnp.moveaxis(v.array, -1, 0) if isinstance(v, _Lanes) else v for v in inputs]
    axes = tuple(0 if isinstance(value, _Lanes) else None for value in inputs)
    results = jax.vmap(lambda *operands: _bind(eqn, operands), in_axes=axes)(*arrays)
    return [jnp.moveaxis(array, 0, -1) for array in results]


def _broadcast(eqn: JaxprEqn, inputs: list[_Value], lanes: int) -> list[Array]:
    shape, dims = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    return [lax.broadcast_in_dim(inputs[0].array, (*shape, lanes), (*dims, len(shape)))]


def _reshape(eqn: JaxprEqn, inputs: list[_Value], lanes: int) -> list[Array]:
    return [inputs[0].array.reshape(*eqn.params["new_sizes"], lanes)]


def _transpose(eqn: JaxprEqn, inputs: list[_Value], lanes: int) -> list[Array]:
    order = eqn.params["permutation"]
    return [lax.transpose(inputs[0].array, (*order, len(order)))]


def _slice(eqn: JaxprEqn, inputs: list[_Value], lanes: int) -> list[Array]:
    starts, limits = eqn.params["start_indices"], eqn.params["limit_indices"]
    strides = eqn.params["strides"]
    strides = None if strides is None else (*strides, 1)
    return [lax.slice(inputs[0].array, (*starts, 0), (*limits, lanes), strides)]


def _pad(eqn: JaxprEqn, inputs: list[_Value], lanes: int) -> list[Array] | None:
    operand, filling = inputs
    if isinstance(filling, _Lanes):
        return None
    return [lax.pad(operand.array, filling, (*eqn.params["padding_config"], (0, 0, 0)))]


def _dot_general(eqn: JaxprEqn, inputs: list[_Value], lanes: int) -> list[Array] | None:
    (left, right), ((left_dims, right_dims), batch) = inputs, eqn.params["dimension_numbers"]
    if isinstance(left, _Lanes) and isinstance(right, _Lanes) or batch != ((), ()):
        return None
    if isinstance(right, _Lanes):
        return _bind(eqn, [left, right.array])
    swapped = ((right_dims, left_dims), batch)
    product = _bind(eqn, [right, left.array], dimension_numbers=swapped)[0]
    ahead = right.ndim - len(right_dims)
    order = (*range(ahead, product.ndim - 1), *range(ahead), product.ndim - 1)
    return [lax.transpose(product, order)]


def _dynamic_slice(eqn: JaxprEqn, inputs: list[_Value], lanes: int) -> list[Array]:
    operand, *starts = inputs
    shape = shape_of(eqn.invars[0])
    window = _widen(operand, shape, lanes)
    for axis, (start, size) in enumerate(zip(starts, eqn.params["slice_sizes"], strict=True)):
        if not isinstance(start, _Lanes):
            window = lax.dynamic_slice_in_dim(window, start, size, axis)
            continue
        first = jnp.clip(start.array, 0, shape[axis] - size)
        sizes = [1] * len(shape)
        sizes[axis] = size
        steps = jnp.arange(size, dtype=first.dtype).reshape(*sizes, 1)
        indices = steps + jnp.expand_dims(first, tuple(range(len(sizes))))
        window = jnp.take_along_axis(window, indices, axis)
    return [window]


_RULES: dict[str, Callable[..., list[Array] | None]] = {
    "broadcast_in_dim": _broadcast,
    "dot_general": _dot_general,
    "dynamic_slice": _dynamic_slice,
    "pad": _pad,
    "reshape": _reshape,
    "slice": _slice,
    "transpose": _transpose,
}
