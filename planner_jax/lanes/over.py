"""`over_lanes`: `jax.vmap` that keeps the lanes on the last axis of every array.

`vmap` puts the lanes first, so that the few numbers of one lane lie next to each other. In a
loop that is bound by memory the neighbours should be the same number of other lanes: every
read is then one whole line of memory, a sum over samples needs no exchange between threads,
and the product with a constant matrix is one large product. Same numbers, another layout.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend.core import ClosedJaxpr, JaxprEqn

from planner_jax.lanes import pallas
from planner_jax.lanes.attach import CallKernel, kernel_of
from planner_jax.lanes.walk import called, evaluate, shape_of

_ELEMENTWISE = frozenset(
    "abs acos add add_any and asin atan atan2 cbrt ceil clamp convert_element_type "
    "cos cosh div eq erf exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p logistic "
    "lt max min mul ne neg not or pow reduce_precision rem round rsqrt select_n sign sin sinh "
    "sqrt square sub tan tanh xor".split()
)
# Their parameters name axes by number from the front, which the lanes do not move.
_BY_AXIS = frozenset(
    "argmax argmin cumlogsumexp cummax cummin cumprod cumsum reduce_and reduce_max reduce_min "
    "reduce_or reduce_prod reduce_sum rev sort split squeeze unstack concatenate stack".split()
)


def over_lanes(function: Callable) -> Callable:
    """The function on many lanes at once.

    Args:
        function: of pytrees of arrays of ONE lane, to a pytree of arrays.

    Returns:
        A function of the same pytrees with one more, last, axis on every leaf: the lanes.
        Its results too have the lanes last. To rounding it is `jax.vmap` with all axes -1; it
        is meant for the inside of a compiled function, and cannot be differentiated where
        `function` has derivatives of its own making (differentiate within `function`).
    """

    @functools.wraps(function)
    def mapped(*args: Any) -> Any:
        leaves, treedef = jax.tree.flatten(args)
        lanes = leaves[0].shape[-1]
        single = [jax.ShapeDtypeStruct(leaf.shape[:-1], leaf.dtype) for leaf in leaves]
        closed, shape = jax.make_jaxpr(function, return_shape=True)(
            *jax.tree.unflatten(treedef, single)
        )
        results = _full_results(closed, leaves, lanes)
        return jax.tree.unflatten(jax.tree.structure(shape), results)

    return mapped


class _Lanes:
    """An array with lanes on its last axis; anything else is the same for all lanes."""

    def __init__(self, array: Array) -> None:
        self.array = array


def _widened(value: Any, shape: tuple[int, ...], lanes: int) -> Array:
    """The array of a value, of (*shape, lanes)."""
    if isinstance(value, _Lanes):
        return value.array
    return jnp.broadcast_to(jnp.asarray(value)[..., None], (*shape, lanes))


def _evaluate(closed: ClosedJaxpr, args: list[Any], lanes: int) -> list[Any]:
    """Values of the outputs, `_Lanes` or not, of a function of one lane."""
    return evaluate(closed, args, functools.partial(_outputs, lanes=lanes))


def _full_results(closed: ClosedJaxpr, leaves: Any, lanes: int) -> list[Array]:
    """Results of a function of one lane, all with the lanes last, of arguments that are so."""
    values = _evaluate(closed, [_Lanes(leaf) for leaf in leaves], lanes)
    pairs = zip(values, closed.jaxpr.outvars, strict=True)
    return [_widened(value, shape_of(out), lanes) for value, out in pairs]


def _outputs(eqn: JaxprEqn, inputs: list[Any], lanes: int) -> list[Any]:
    """Values of the outputs of one operation, by a kernel or a rule if there is one for it."""
    name, closed = eqn.primitive.name, called(eqn)
    if closed is not None:
        kernel = kernel_of(eqn) if pallas.in_use() else None
        if kernel is None:
            return _evaluate(closed, inputs, lanes)
        return _by_kernel(eqn, closed, kernel, inputs, lanes)
    if not any(isinstance(value, _Lanes) for value in inputs):
        return _bound(eqn, inputs)
    shapes = [shape_of(atom) for atom in eqn.invars]
    arrays = None
    if name in _ELEMENTWISE:
        out_shape = shape_of(eqn.outvars[0])
        arrays = _bound(eqn, [_spread(value, out_shape, lanes) for value in inputs])
    elif name in _BY_AXIS:
        arrays = _bound(eqn, [_widened(v, s, lanes) for v, s in zip(inputs, shapes, strict=True)])
    elif name in _RULES:
        arrays = _RULES[name](eqn, inputs, lanes)
    if arrays is None:
        return _mapped(eqn, inputs)
    return [_Lanes(array) for array in arrays]


def _by_kernel(
    eqn: JaxprEqn, closed: ClosedJaxpr, kernel: CallKernel, inputs: list[Any], lanes: int
) -> list[Any]:
    """Results of a called function that has a kernel.

    The program holds both: the kernel, which is compiled for CUDA, and the function's operations,
    which are compiled for every other device, or where the kernel is not made for the shapes.
    """
    arrays = [
        _widened(v, shape_of(atom), lanes) for v, atom in zip(inputs, eqn.invars, strict=True)
    ]
    shapes = [(*shape_of(atom), lanes) for atom in eqn.outvars]

    def by_operations(*leaves: Array) -> list[Array]:
        return _full_results(closed, leaves, lanes)

    def in_kernel(*leaves: Array) -> list[Array]:
        results = kernel(leaves)
        if results is None:
            return by_operations(*leaves)
        # A result that does not vary along an axis of `vmap` does not have it.
        pairs = zip(results, shapes, strict=True)
        results = [result[(0,) * (result.ndim - len(shape))] for result, shape in pairs]
        as_called = all(r.shape == shape for r, shape in zip(results, shapes, strict=True))
        return results if as_called else by_operations(*leaves)

    return [
        _Lanes(leaf)
        for leaf in lax.platform_dependent(*arrays, cuda=in_kernel, default=by_operations)
    ]


def _bound(eqn: JaxprEqn, inputs: list[Any], **changes: Any) -> list[Any]:
    """Results of the operation itself, some of its parameters changed."""
    results = eqn.primitive.bind(*inputs, **{**eqn.params, **changes})
    return list(results) if eqn.primitive.multiple_results else [results]


def _spread(value: Any, shape: tuple[int, ...], lanes: int) -> Array:
    """An operand of an elementwise operation, of (*shape, lanes)."""
    array = value.array if isinstance(value, _Lanes) else jnp.asarray(value)[..., None]
    if array.ndim == 1 and shape:  # one number a lane, such as the bound of a clamp
        array = array.reshape((1,) * len(shape) + array.shape)
    return jnp.broadcast_to(array, (*shape, lanes))


def _mapped(eqn: JaxprEqn, inputs: list[Any]) -> list[Any]:
    """Results of any operation, by way of `jax.vmap` with the lanes first."""
    arrays = [jnp.moveaxis(v.array, -1, 0) if isinstance(v, _Lanes) else v for v in inputs]
    axes = tuple(0 if isinstance(value, _Lanes) else None for value in inputs)
    results = jax.vmap(lambda *operands: _bound(eqn, list(operands)), in_axes=axes)(*arrays)
    return [_Lanes(jnp.moveaxis(array, 0, -1)) for array in results]


def _broadcast(eqn: JaxprEqn, inputs: list[Any], lanes: int) -> list[Any]:
    shape, dims = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    return [lax.broadcast_in_dim(inputs[0].array, (*shape, lanes), (*dims, len(shape)))]


def _reshape(eqn: JaxprEqn, inputs: list[Any], lanes: int) -> list[Any]:
    return [inputs[0].array.reshape(*eqn.params["new_sizes"], lanes)]


def _transpose(eqn: JaxprEqn, inputs: list[Any], lanes: int) -> list[Any]:
    order = eqn.params["permutation"]
    return [lax.transpose(inputs[0].array, (*order, len(order)))]


def _slice(eqn: JaxprEqn, inputs: list[Any], lanes: int) -> list[Any]:
    strides = eqn.params["strides"]
    return [
        lax.slice(
            inputs[0].array,
            (*eqn.params["start_indices"], 0),
            (*eqn.params["limit_indices"], lanes),
            None if strides is None else (*strides, 1),
        )
    ]


def _pad(eqn: JaxprEqn, inputs: list[Any], lanes: int) -> list[Any] | None:
    operand, filling = inputs
    if isinstance(filling, _Lanes):
        return None
    return [lax.pad(operand.array, filling, (*eqn.params["padding_config"], (0, 0, 0)))]


def _dot_general(eqn: JaxprEqn, inputs: list[Any], lanes: int) -> list[Any] | None:
    """A product with a matrix that all lanes share: one product, the lanes among its columns."""
    (left, right), ((left_dims, right_dims), batch) = inputs, eqn.params["dimension_numbers"]
    both = isinstance(left, _Lanes) and isinstance(right, _Lanes)
    if both or batch != ((), ()):
        return None
    if isinstance(right, _Lanes):
        return _bound(eqn, [left, right.array])
    swapped = ((right_dims, left_dims), batch)
    product = _bound(eqn, [right, left.array], dimension_numbers=swapped)[0]
    ahead = right.ndim - len(right_dims)
    places = (*range(ahead, product.ndim - 1), *range(ahead), product.ndim - 1)
    return [lax.transpose(product, places)]


def _dynamic_slice(eqn: JaxprEqn, inputs: list[Any], lanes: int) -> list[Any] | None:
    """A window that each lane begins elsewhere."""
    operand, *starts = inputs
    shape = shape_of(eqn.invars[0])
    window = _widened(operand, shape, lanes)
    for axis, (start, size) in enumerate(zip(starts, eqn.params["slice_sizes"], strict=True)):
        if not isinstance(start, _Lanes):
            window = lax.dynamic_slice_in_dim(window, start, size, axis)
            continue
        first = jnp.clip(start.array, 0, shape[axis] - size)
        places = [1] * len(shape)
        places[axis] = size
        places = jnp.arange(size, dtype=first.dtype).reshape(*places, 1) + first
        window = jnp.take_along_axis(window, places, axis)
    return [window]


_RULES: dict[str, Callable[[JaxprEqn, list[Any], int], list[Any] | None]] = {
    "broadcast_in_dim": _broadcast,
    "dot_general": _dot_general,
    "dynamic_slice": _dynamic_slice,
    "pad": _pad,
    "reshape": _reshape,
    "slice": _slice,
    "transpose": _transpose,
}
