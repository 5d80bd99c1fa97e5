"""`over_lanes`: `jax.vmap` that keeps the lanes on the last axis of every array.

`vmap` puts the lanes first, so that the few numbers of one lane lie next to each other. In a
loop that is bound by memory the neighbours should be the same number of other lanes: every
read is then one whole line of memory, a sum over samples needs no exchange between threads,
and the product with a constant matrix is one large product. Same numbers, another layout.
"""

import dataclasses
import functools
import importlib.util
import math
import sys
import types
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import ClosedJaxpr, JaxprEqn

from planner_jax.jaxprs import called, evaluate, shape_of
from planner_jax.lanes_kernel import Unsupported, lanes_kernel

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
        found = _evaluate(closed, [_Lanes(leaf) for leaf in leaves], lanes)
        full = [
            _widened(value, shape_of(out), lanes)
            for value, out in zip(found, closed.jaxpr.outvars, strict=True)
        ]
        return jax.tree.unflatten(jax.tree.structure(shape), full)

    return mapped


# A kernel takes the tree of a function's arguments and their leaves, with the lanes last; it gives
# the leaves of the results, or None where it is not made for such shapes.
Kernel = Callable[[Any, Sequence[Array]], list[Array] | None]


@dataclasses.dataclass
class _Named:
    """What a name of a compiled function stands for."""

    kernel: Callable[[Sequence[Array]], list[Array] | None]
    shapes: list[tuple[int, ...]]  # of the arguments' leaves, then of the results'


_KERNELS: dict[str, _Named] = {}
_HALVED = "halved_"  # begins the names of functions whose halves are made kernels
_FEWEST = 16  # lanes that are worth a block of a kernel
_BLOCK = 32  # lanes of a block


def with_kernel(
    function: Callable, kernel: Kernel, key: Any = None, jvp: Callable | None = None
) -> Callable:
    """The function, for which `over_lanes` calls a kernel where the program is for CUDA.

    Args:
        function: of pytrees of arrays of ONE lane, to a pytree of arrays.
        kernel: the same on lanes. `jax.vmap` within a lane adds axes in front of some leaves;
            where it has put one elsewhere, as after a matrix product, no kernel is called.
        key: constants that tell the function from others of its code, by their `repr`.
        jvp: its derivative as `jax.custom_jvp` takes it, zeros as `SymbolicZero`; without it,
            the function's own.
    """
    return _with_kernels(function, lambda treedef, _: functools.partial(kernel, treedef), key, jvp)


def _with_kernels(
    function: Callable, kernel: Callable[[Any, tuple], Any], key: Any, jvp: Callable | None
) -> Callable:
    """`with_kernel` that makes a kernel for each tree and shapes of arguments."""

    @functools.cache
    def compiled(treedef: Any, shapes: tuple) -> Callable:
        # The same in every process, whatever it did before: kept programs are found by it.
        text = repr((_name_of(function), key, treedef, shapes))
        name = f"kernel_{zlib.crc32(text.encode()):08x}"
        while name in _KERNELS:
            name += "_"
        here = _KERNELS[name] = _Named(kernel(treedef, shapes), [])

        def named(*leaves: Array) -> Any:
            found = function(*jax.tree.unflatten(treedef, leaves))
            here.shapes = [*shapes, *(leaf.shape for leaf in jax.tree.leaves(found))]
            return found

        named.__name__ = named.__qualname__ = name
        return jax.jit(named)

    # A derivative of the named function would bear its name, and be taken for it.
    @jax.custom_jvp
    def guarded(*args: Any) -> Any:
        leaves, treedef = jax.tree.flatten(args)
        shapes: Any = tuple(jnp.shape(leaf) for leaf in leaves)
        return compiled(treedef, shapes)(*leaves)

    if jvp is None:
        guarded.defjvp(lambda primals, tangents: jax.jvp(function, primals, tangents))
    else:
        guarded.defjvp(jvp, symbolic_zeros=True)
    return guarded


def _name_of(function: Callable) -> str:
    return getattr(function, "__qualname__", type(function).__name__)


@functools.cache
def in_one_kernel(static: Callable, *constants: Any) -> Callable:
    """A function of its constants and more, of which `over_lanes` makes one kernel for CUDA.

    So it does of each half that reverse mode splits it into, if only the first argument moves. It
    is for arithmetic on arrays of a few numbers: what `lanes_kernel` cannot take stays as it is.

    Args:
        static: of the constants, then of pytrees of arrays of ONE lane, to a pytree of arrays.
        constants: hashable. For the same ones there is one kernel: give what does not vary, such
            as a planner, in this way and not by a new function object.
    """
    function = functools.partial(static, *constants)

    # The way back computes anew what it needs: that is quicker than reading it.
    again = jax.checkpoint(function, prevent_cse=False)

    def named(*args: Any) -> Any:
        return again(*args)

    named.__name__ = named.__qualname__ = _HALVED + _name_of(static)
    halved = jax.jit(named)

    def kernel(treedef: Any, shapes: tuple) -> Callable:
        def flat(*leaves: Array) -> list[Array]:
            return jax.tree.leaves(function(*jax.tree.unflatten(treedef, leaves)))

        def in_lanes(leaves: Sequence[Array]) -> list[Array] | None:
            pairs = zip(shapes, leaves, strict=True)
            one = [jax.ShapeDtypeStruct(shape, leaf.dtype) for shape, leaf in pairs]
            return _small_kernel(jax.make_jaxpr(flat)(*one), leaves)

        return in_lanes

    def slope(primals: tuple, tangents: tuple) -> tuple:
        leaves, treedef = jax.tree.flatten(primals)
        along = jax.tree.leaves(tangents)
        moving = [k for k, t in enumerate(along) if not isinstance(t, SymbolicZero)]
        of_first = len(jax.tree.leaves(primals[0]))
        by_first = all(k < of_first for k in moving)
        derived = halved if by_first and _has_kernels() else function

        def of_moving(*moved: Array) -> Any:
            every = list(leaves)
            for k, leaf in zip(moving, moved, strict=True):
                every[k] = leaf
            return derived(*jax.tree.unflatten(treedef, every))

        return jax.jvp(of_moving, tuple(leaves[k] for k in moving), tuple(along[k] for k in moving))

    return _with_kernels(function, kernel, (_name_of(static), constants), slope)


def _has_kernels() -> bool:
    """Whether programs are for a device that kernels are made for."""
    return jax.default_backend() == "gpu"


def _small_kernel(closed: ClosedJaxpr, args: Sequence[Any]) -> list[Array] | None:
    """What a kernel makes of a jaxpr of one lane, or None where there is none."""
    lanes = next((x.shape[-1] for x in args if not isinstance(x, np.ndarray)), 0)
    threads = block_width(lanes, _BLOCK) if lanes else None
    try:
        return None if threads is None else lanes_kernel(closed, args, threads)
    except Unsupported:
        return None


def _half_kernel(closed: ClosedJaxpr, inputs: list[Any]) -> Callable:
    """The kernel of a half; constants that the half is handed are constants in it."""
    fixed = [isinstance(x, np.ndarray | Array) and not isinstance(x, Tracer) for x in inputs]

    def kernel(leaves: Sequence[Array]) -> list[Array] | None:
        pairs = zip(inputs, leaves, fixed, strict=True)
        return _small_kernel(
            closed, [np.asarray(x) if is_fixed else leaf for x, leaf, is_fixed in pairs]
        )

    return kernel


def _kernel_of(eqn: JaxprEqn, closed: ClosedJaxpr, inputs: list[Any]) -> Callable | None:
    """The kernel of the lanes' arrays for a call, if it is of a function that has one."""
    name = eqn.params.get("name", "")
    if name.startswith(_HALVED):
        return _half_kernel(closed, inputs)
    named = _KERNELS.get(name)
    if named is None:
        return None
    # Reverse mode splits compiled functions in two that keep the name: a half is something else.
    shapes = [shape_of(atom) for atom in (*eqn.invars, *eqn.outvars)]
    is_whole = len(shapes) == len(named.shapes) and all(
        full[len(full) - len(own) :] == own for full, own in zip(shapes, named.shapes, strict=True)
    )
    return named.kernel if is_whole else None


def block_width(lanes: int, most: int) -> int | None:
    """Lanes of a kernel's block: `most`, a power of two, or as many as divide all evenly.

    None where that would be too few to be worth a block.
    """
    width = math.gcd(lanes, most)
    return width if width >= _FEWEST else None


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
    outputs = functools.partial(_outputs, lanes=lanes)
    return evaluate(closed.jaxpr, closed.consts, args, outputs)


def _outputs(eqn: JaxprEqn, inputs: list[Any], lanes: int) -> list[Any]:
    """What one operation makes of its inputs."""
    name, closed = eqn.primitive.name, called(eqn)
    if closed is not None:
        kernel = _kernel_of(eqn, closed, inputs) if _has_kernels() else None
        if kernel is None:
            return _evaluate(closed, inputs, lanes)
        return _by_kernel(eqn, closed, kernel, inputs, lanes)
    if not any(isinstance(value, _Lanes) for value in inputs):
        return _bound(eqn, inputs)
    shapes = [shape_of(atom) for atom in eqn.invars]
    found = None
    if name in _ELEMENTWISE:
        out_shape = shape_of(eqn.outvars[0])
        found = _bound(eqn, [_spread(value, out_shape, lanes) for value in inputs])
    elif name in _BY_AXIS:
        found = _bound(eqn, [_widened(v, s, lanes) for v, s in zip(inputs, shapes, strict=True)])
    elif name in _RULES:
        found = _RULES[name](eqn, inputs, lanes)
    if found is None:
        return _mapped(eqn, inputs)
    return [_Lanes(array) for array in found]


def _by_kernel(
    eqn: JaxprEqn, closed: ClosedJaxpr, kernel: Callable, inputs: list[Any], lanes: int
) -> list[Any]:
    """A function that has a kernel: that for CUDA, and what the function says elsewhere."""
    _spare_searches()
    arrays = [
        _widened(v, shape_of(atom), lanes) for v, atom in zip(inputs, eqn.invars, strict=True)
    ]

    shapes = [(*shape_of(atom), lanes) for atom in eqn.outvars]

    def in_kernel(*leaves: Array) -> list[Array]:
        found = kernel(leaves)
        if found is None:
            return in_steps(*leaves)
        # What does not vary along an axis of `vmap` does not have it.
        found = [leaf[(0,) * (leaf.ndim - len(s))] for leaf, s in zip(found, shapes, strict=True)]
        same = all(leaf.shape == s for leaf, s in zip(found, shapes, strict=True))
        return found if same else in_steps(*leaves)

    def in_steps(*leaves: Array) -> list[Array]:
        found = _evaluate(closed, [_Lanes(leaf) for leaf in leaves], lanes)
        return [_widened(v, s[:-1], lanes) for v, s in zip(found, shapes, strict=True)]

    return [
        _Lanes(leaf) for leaf in lax.platform_dependent(*arrays, cuda=in_kernel, default=in_steps)
    ]


@functools.cache
def _spare_searches() -> None:
    """Have a kernel lowered in two thirds of the time.

    For every value that it hands to Python, MLIR imports a module of Triton's dialect, which
    jaxlib does not ship: thousands of searches of the path, unless an empty one is found.
    """
    name = "jaxlib.mlir.dialects.tt"
    if importlib.util.find_spec(name) is None:
        sys.modules.setdefault(name, types.ModuleType(name))


def _bound(eqn: JaxprEqn, inputs: list[Any], **changes: Any) -> list[Any]:
    """The operation itself, some of its parameters changed."""
    found = eqn.primitive.bind(*inputs, **{**eqn.params, **changes})
    return list(found) if eqn.primitive.multiple_results else [found]


def _spread(value: Any, shape: tuple[int, ...], lanes: int) -> Array:
    """An operand of an elementwise operation, of (*shape, lanes)."""
    array = value.array if isinstance(value, _Lanes) else jnp.asarray(value)[..., None]
    if array.ndim == 1 and shape:  # one number a lane, such as the bound of a clamp
        array = array.reshape((1,) * len(shape) + array.shape)
    return jnp.broadcast_to(array, (*shape, lanes))


def _mapped(eqn: JaxprEqn, inputs: list[Any]) -> list[Any]:
    """Any operation, by way of `jax.vmap` with the lanes first."""
    arrays = [jnp.moveaxis(v.array, -1, 0) if isinstance(v, _Lanes) else v for v in inputs]
    axes = tuple(0 if isinstance(value, _Lanes) else None for value in inputs)
    found = jax.vmap(lambda *operands: _bound(eqn, list(operands)), in_axes=axes)(*arrays)
    return [_Lanes(jnp.moveaxis(array, 0, -1)) for array in found]


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
    found = _bound(eqn, [right, left.array], dimension_numbers=swapped)[0]
    ahead = right.ndim - len(right_dims)
    places = (*range(ahead, found.ndim - 1), *range(ahead), found.ndim - 1)
    return [lax.transpose(found, places)]


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
