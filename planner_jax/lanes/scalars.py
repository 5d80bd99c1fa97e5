"""A small function of one lane made into one kernel, number by number.

In the kernel a thread carries a lane and keeps every number of every array in a register of its
own. The function is taken apart into operations on single numbers, each done once and only if a
result needs it. So shapes cost nothing: where JAX's operations are a launch for each concatenation
and each sum over an axis, the kernel is one launch altogether. Vectors that only pass through
should stay outside: the compiler's time grows with the numbers that cross between a kernel and the
memory.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import ClosedJaxpr, JaxprEqn, Primitive

from planner_jax.lanes import pallas
from planner_jax.lanes.walk import called, evaluate, shape_of

# Triton's compiler visits, for every access to memory, all operations from all operations. So many
# accesses times squared operations take it some 5 s; larger functions are refused.
_MOST = 3e8

_ELEMENTWISE = frozenset(
    "abs add add_any and atan2 ceil clamp convert_element_type cos div eq exp expm1 floor ge gt "
    "integer_pow is_finite le log log1p lt max min mul ne neg not or pow rsqrt select_n sign sin "
    "sqrt square sub tan tanh xor".split()
)
_FOLDS: dict[str, Primitive] = {
    "reduce_and": lax.and_p,
    "reduce_max": lax.max_p,
    "reduce_min": lax.min_p,
    "reduce_or": lax.or_p,
    "reduce_sum": lax.add_p,
}
_TYPES = frozenset(map(np.dtype, (np.float32, np.float64, np.int32, np.int64, np.bool_)))


class Unsupported(Exception):
    """The function has operations that a kernel cannot have, or too many."""


def scalar_kernel(
    closed: ClosedJaxpr,
    args: Sequence[Array | np.ndarray],
    threads: int,
    *,
    interpret: bool = False,
) -> list[Array]:
    """Results of the function on many lanes, by a kernel.

    Args:
        closed: the function of one lane.
        args: its arguments: jax arrays with the lanes on the last axis, some of which may have
            further axes in front, that are then in front of all results; and NumPy arrays, which
            are the same for all lanes.
        threads: lanes of a block.
        interpret: run it without a GPU, for tests.

    Returns:
        The results with the lanes on the last axis.

    Raises:
        Unsupported: no such kernel can be made.
    """
    numbers = _Numbers()
    leaves, own, values = [], [], []
    for arg, aval in zip(args, closed.in_avals, strict=True):
        if isinstance(arg, np.ndarray):
            values.append(arg)
            continue
        values.append(_Argument(numbers, len(leaves), aval.shape, aval.dtype))
        leaves.append(arg)
        own.append(aval.shape)
    out: Any = [(aval.shape, aval.dtype) for aval in closed.out_avals]
    pairs = zip(_evaluate(numbers, closed, values), out, strict=True)
    results = [_entries(value, shape) for value, (shape, _) in pairs]
    needed = numbers.needed_by(results)
    accesses = sum(number.is_read for number in needed) + sum(entries.size for entries in results)
    if accesses * len(needed) ** 2 > _MOST:
        raise Unsupported("too large a function")
    if any(0 in shape for shape in (*own, *(shape for shape, _ in out))):
        raise Unsupported("an array without numbers")

    def body(*refs):
        arrays: dict[int, Array] = {}

        def array(entry: Any, dtype: Any) -> Array:
            if isinstance(entry, _Number):
                return arrays[entry.index]
            return jnp.full((threads,), entry, dtype)

        for number in needed:
            arrays[number.index] = number.make(refs, array)
        for ref, entries, (shape, dtype) in zip(refs[len(own) :], results, out, strict=True):
            for index in np.ndindex(*shape):
                ref[index or ...] = array(entries[index], dtype)

    def block(shape: tuple[int, ...], has_lead: bool = True) -> pallas.Block:
        zeros = (0,) * len(shape)
        if has_lead:
            return (None, *shape, threads), lambda t, i: (t, *zeros, i)
        return (*shape, threads), lambda t, i: (*zeros, i)

    leads = [x.shape[: x.ndim - 1 - len(shape)] for x, shape in zip(leaves, own, strict=True)]
    lead, lanes = jnp.broadcast_shapes(*leads), leaves[0].shape[-1]
    num: Any = math.prod(lead)
    flat = [
        jnp.broadcast_to(leaf, (*lead, *shape, lanes)).reshape(num, *shape, lanes) if has else leaf
        for leaf, shape, has in zip(leaves, own, leads, strict=True)
    ]
    arrays = pallas.kernel_call(
        body,
        (num, lanes // threads),
        [block(shape, bool(has)) for shape, has in zip(own, leads, strict=True)],
        [((num, *shape, lanes), dtype, block(shape)) for shape, dtype in out],
        name="lanes",
        threads=threads,
        interpret=interpret,
    )(*flat)
    return [array.reshape(*lead, *array.shape[1:]) for array in arrays]


@dataclasses.dataclass(eq=False)
class _Number:
    """One number of every lane: how a kernel makes it of others, or of its arguments' refs."""

    index: int
    operands: tuple[Any, ...]  # numbers, or what is the same for all lanes
    make: Callable[[Sequence[Any], Callable], Array]
    is_read: bool = False  # from memory


class _Numbers:
    """All numbers of a kernel, each of them once."""

    def __init__(self) -> None:
        self.known: dict[tuple, _Number] = {}

    def number(self, operands: Sequence[Any], make: Callable, *key: Any) -> _Number:
        """The number that a function makes of operands; the key tells such functions apart."""
        named = tuple(
            (entry.index, None) if isinstance(entry, _Number) else (repr(entry), type(entry))
            for entry in operands
        )
        if (*key, named) not in self.known:
            self.known[*key, named] = _Number(len(self.known), tuple(operands), make)
        return self.known[*key, named]

    def operation(
        self, primitive: Primitive, operands: Sequence[Any], dtypes: Sequence[Any], params: dict
    ) -> Any:
        """The result of an elementwise operation."""
        plain = primitive.name.replace("add_any", "add")
        if plain in ("add", "sub") and _is(operands[1], 0.0):
            return operands[0]
        if plain == "add" and _is(operands[0], 0.0):
            return operands[1]
        if plain == "mul" and (_is(operands[0], 1.0) or _is(operands[1], 1.0)):
            return operands[_is(operands[0], 1.0)]

        def make(_: Any, array: Callable) -> Array:
            return primitive.bind(*map(array, operands, dtypes), **params)

        return self.number(operands, make, plain, repr(params), *map(str, dtypes))

    def paired(self, primitive: Primitive, dtype: Any) -> Callable:
        """An operation on two numbers of a type, as a function."""
        return lambda a, b: self.operation(primitive, (a, b), (dtype, dtype), {})

    def needed_by(self, results: Sequence[np.ndarray]) -> list[_Number]:
        """The numbers that some entries are made of, and these, in order."""
        needed: dict[int, _Number] = {}
        waiting = [entry for entries in results for entry in entries.ravel()]
        while waiting:
            entry = waiting.pop()
            if isinstance(entry, _Number) and entry.index not in needed:
                needed[entry.index] = entry
                waiting += entry.operands
        return [needed[index] for index in sorted(needed)]


class _Argument:
    """An argument, the numbers of which are read where they are needed."""

    def __init__(self, numbers: _Numbers, place: int, shape: tuple[int, ...], dtype: Any) -> None:
        if np.dtype(dtype) not in _TYPES:
            raise Unsupported(dtype)
        self.numbers, self.place, self.shape = numbers, place, shape

    @functools.cached_property
    def entries(self) -> np.ndarray:
        return _filled(self.shape, self.at)

    def at(self, index: Sequence[Any]) -> _Number:
        """The number at a place, which each lane may have for itself."""
        own = [k for k in index if isinstance(k, _Number)]

        def make(refs: Sequence[Any], array: Callable) -> Array:
            if not own:
                return refs[self.place][tuple(index) or ...]
            places = [array(k, jnp.int32) if isinstance(k, _Number) else k for k in index]
            ref = refs[self.place]
            lanes = lax.broadcasted_iota(jnp.int32, ref.shape[-1:], 0)
            return pallas.load(ref, (*places, lanes))

        fixed = tuple(None if isinstance(k, _Number) else k for k in index)
        number = self.numbers.number(own, make, "argument", self.place, fixed)
        number.is_read = True
        return number


def _dtype(atom: Any) -> Any:
    return atom.aval.dtype


def _entries(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Array of objects: a `_Number`, or what is the same for all lanes."""
    if isinstance(value, _Argument):
        return value.entries
    return np.broadcast_to(np.asarray(value).astype(object), shape)


def _is(entry: Any, number: float) -> bool:
    return not isinstance(entry, _Number) and entry == number


def _filled(shape: tuple[int, ...], entry: Callable) -> np.ndarray:
    """The array of the entry at every index."""
    array = np.empty(shape, object)
    for index in np.ndindex(*shape):
        array[index] = entry(index)
    return array


def _evaluate(numbers: _Numbers, closed: ClosedJaxpr, args: list[Any]) -> list[Any]:
    """Values of the outputs of a function."""
    return evaluate(closed, args, functools.partial(_outputs, numbers))


def _outputs(numbers: _Numbers, eqn: JaxprEqn, inputs: list[Any]) -> list[Any]:
    """Values of the outputs of one operation: arrays of numbers."""
    inner = called(eqn)
    if inner is not None:
        return _evaluate(numbers, inner, inputs)
    name, shape = eqn.primitive.name, shape_of(eqn.outvars[0])
    dtypes = [_dtype(atom) for atom in eqn.invars]
    if name == "dynamic_slice":
        return [_window(numbers, eqn, inputs)]
    if name == "gather":
        return [_gathered(numbers, eqn, inputs)]
    operands = [_entries(v, shape_of(a)) for v, a in zip(inputs, eqn.invars, strict=True)]
    if name in _ELEMENTWISE:
        wide = [np.broadcast_to(operand, shape) for operand in operands]

        def entry(index: tuple[int, ...]) -> Any:
            single = [operand[index] for operand in wide]
            return numbers.operation(eqn.primitive, single, dtypes, eqn.params)

        return [_filled(shape, entry)]
    if name in _FOLDS:
        axes = eqn.params["axes"]
        kept = [k for k in range(operands[0].ndim) if k not in axes]
        rows = operands[0].transpose(*kept, *axes).reshape(*shape, -1)
        pair = numbers.paired(_FOLDS[name], dtypes[0])
        return [_filled(shape, lambda index: functools.reduce(pair, rows[index]))]
    if name == "cumsum":
        return [_running(operands[0], eqn.params, numbers.paired(lax.add_p, dtypes[0]))]
    if name == "argmin":
        return [_least(numbers, eqn, operands[0])]
    if name == "dot_general":
        left, right = operands
        pair = functools.partial(numbers.paired, dtype=dtypes[0])
        return [_product(eqn, left, right, pair(lax.mul_p), pair(lax.add_p))]
    if name in _MOVES:
        moved = _MOVES[name](eqn.params, shape, *operands)
        return moved if eqn.primitive.multiple_results else [moved]
    raise Unsupported(name)


def _running(operand: np.ndarray, params: dict, add: Callable) -> np.ndarray:
    """Sums up to each entry of an axis."""
    order = slice(None, None, -1 if params["reverse"] else 1)
    rows = np.moveaxis(operand, params["axis"], -1)
    sums = np.empty(rows.shape, object)
    for index in np.ndindex(rows.shape[:-1]):
        running = list(itertools.accumulate(rows[index][order], add))
        for place, value in enumerate(running[order]):
            sums[(*index, place)] = value
    return np.moveaxis(sums, -1, params["axis"])


def _least(numbers: _Numbers, eqn: JaxprEqn, operand: np.ndarray) -> np.ndarray:
    """Places of the least entries of an axis; one that is not a number is less than all."""
    (axis,) = eqn.params["axes"]
    dtype, wanted = _dtype(eqn.invars[0]), eqn.params["index_dtype"]
    rows = np.moveaxis(operand, axis, -1)

    def place(index: tuple[int, ...]) -> _Number:
        def make(_: Any, array: Callable) -> Array:
            first, *others = (array(entry, dtype) for entry in rows[index])
            best, where = first, jnp.zeros(first.shape, wanted)
            for k, other in enumerate(others, 1):
                less = ((other < best) | (other != other)) & (best == best)
                best = jnp.where(less, other, best)
                where = jnp.where(less, jnp.full(first.shape, k, wanted), where)
            return where

        return numbers.number(tuple(rows[index]), make, "argmin", str(wanted))

    return _filled(rows.shape[:-1], place)


def _product(
    eqn: JaxprEqn, left: np.ndarray, right: np.ndarray, multiply: Callable, add: Callable
) -> np.ndarray:
    (left_dims, right_dims), (left_batch, right_batch) = eqn.params["dimension_numbers"]

    def arranged(operand: np.ndarray, dims: Sequence[int], batch: Sequence[int]) -> np.ndarray:
        """With the axes (*batch, free, contracted)."""
        free = [k for k in range(operand.ndim) if k not in (*dims, *batch)]
        sizes = [operand.shape[k] for k in batch]
        size = math.prod(operand.shape[k] for k in free)
        return operand.transpose(*batch, *free, *dims).reshape(*sizes, size, -1)

    left, right = arranged(left, left_dims, left_batch), arranged(right, right_dims, right_batch)

    def entry(index: tuple[int, ...]) -> Any:
        *batch, i, j = index
        terms = map(multiply, left[(*batch, i)], right[(*batch, j)])
        return functools.reduce(add, terms)

    product = _filled((*left.shape[:-1], right.shape[-2]), entry)
    return product.reshape(shape_of(eqn.outvars[0]))


def _place(
    numbers: _Numbers, start: Any, offset: int, size: int, window: int, dtype: Any
) -> int | _Number:
    """A place along an axis, the window's start kept inside."""
    if not isinstance(start, _Number):
        return min(max(int(start), 0), size - window) + offset

    def make(_: Any, array: Callable) -> Array:
        first = array(start, dtype)
        zero, last = (jnp.full(first.shape, k, dtype) for k in (0, size - window))
        return lax.clamp(zero, first, last) + jnp.full(first.shape, offset, dtype)

    return numbers.number((start,), make, "place", offset, size - window)


def _read(operand: Any, places: list[Any], shape: tuple[int, ...]) -> Any:
    """The operand's entry at places, some of which each lane may have for itself."""
    if all(isinstance(place, int) for place in places):
        return _entries(operand, shape)[tuple(places)]
    if not isinstance(operand, _Argument):
        raise Unsupported("a place of its own for each lane in what is no argument")
    return operand.at(places)


def _window(numbers: _Numbers, eqn: JaxprEqn, inputs: list[Any]) -> np.ndarray:
    operand, *starts = inputs
    shape, sizes = shape_of(eqn.invars[0]), eqn.params["slice_sizes"]
    starts = [_entries(start, ())[()] for start in starts]
    dtypes = [_dtype(atom) for atom in eqn.invars[1:]]

    def entry(index: tuple[int, ...]) -> Any:
        axes = zip(starts, index, shape, sizes, dtypes, strict=True)
        return _read(operand, [_place(numbers, *axis) for axis in axes], shape)

    return _filled(sizes, entry)


def _gathered(numbers: _Numbers, eqn: JaxprEqn, inputs: list[Any]) -> np.ndarray:
    axes, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    if eqn.params["mode"] not in (
        lax.GatherScatterMode.CLIP,
        lax.GatherScatterMode.PROMISE_IN_BOUNDS,
    ):
        raise Unsupported("gather with filling")
    operand, shape, out_shape = inputs[0], shape_of(eqn.invars[0]), shape_of(eqn.outvars[0])
    starts = _entries(inputs[1], shape_of(eqn.invars[1]))
    dtype = _dtype(eqn.invars[1])
    dropped = (*axes.collapsed_slice_dims, *axes.operand_batching_dims)
    inside = [axis for axis in range(len(shape)) if axis not in dropped]

    def entry(index: tuple[int, ...]) -> Any:
        batch = [k for axis, k in enumerate(index) if axis not in axes.offset_dims]
        places: list[Any] = [0] * len(shape)
        for axis, offset_axis in zip(inside, axes.offset_dims, strict=True):
            places[axis] = index[offset_axis]
        for k, axis in enumerate(axes.start_index_map):
            start = starts[(*batch, k)]
            places[axis] = _place(numbers, start, places[axis], shape[axis], sizes[axis], dtype)
        for axis, other in zip(
            axes.operand_batching_dims, axes.start_indices_batching_dims, strict=True
        ):
            places[axis] = batch[other]
        return _read(operand, places, shape)

    return _filled(out_shape, entry)


def _padded(params: dict, shape: tuple[int, ...], operand: np.ndarray, value: np.ndarray) -> Any:
    if any(low < 0 or high < 0 for low, high, _ in params["padding_config"]):
        raise Unsupported("padding that takes away")
    padded = _filled(shape, lambda _: value[()])
    inside = tuple(
        slice(low, low + (size - 1) * (between + 1) + 1, between + 1)
        for size, (low, _, between) in zip(operand.shape, params["padding_config"], strict=True)
    )
    padded[inside] = operand
    return padded


def _broadcast(params: dict, shape: tuple[int, ...], operand: np.ndarray) -> np.ndarray:
    places = params["broadcast_dimensions"]
    ones = [operand.shape[places.index(k)] if k in places else 1 for k in range(len(shape))]
    return np.broadcast_to(operand.reshape(ones), shape)


def _sliced(params: dict, shape: tuple[int, ...], operand: np.ndarray) -> np.ndarray:
    strides = params["strides"] or (1,) * operand.ndim
    return operand[tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]


def _split(params: dict, shape: tuple[int, ...], operand: np.ndarray) -> list[np.ndarray]:
    return np.split(operand, np.cumsum(params["sizes"])[:-1], params["axis"])


def _unstacked(params: dict, shape: tuple[int, ...], operand: np.ndarray) -> list[np.ndarray]:
    rows = np.moveaxis(operand, params["axis"], 0)
    return [rows[k, ...] for k in range(len(rows))]


_MOVES: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda params, shape, *parts: np.concatenate(parts, params["dimension"]),
    "iota": lambda params, shape: np.broadcast_to(
        np.arange(shape[params["dimension"]]).reshape(
            [-1 if k == params["dimension"] else 1 for k in range(len(shape))]
        ),
        shape,
    ),
    "pad": _padded,
    "reshape": lambda params, shape, operand: operand.reshape(shape),
    "rev": lambda params, shape, operand: np.flip(operand, params["dimensions"]),
    "slice": _sliced,
    "split": _split,
    "squeeze": lambda params, shape, operand: operand.reshape(shape),
    "stack": lambda params, shape, *parts: np.stack(parts, params["axis"]),
    "transpose": lambda params, shape, operand: operand.transpose(params["permutation"]),
    "unstack": _unstacked,
}
