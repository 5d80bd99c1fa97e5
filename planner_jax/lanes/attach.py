"""Kernels for functions of one lane: how they are attached, and how `over_lanes` finds them.

A function with a kernel is compiled under a name of its own (`jax.jit`), which it keeps inside
any larger function. `over_lanes` sees the call of that name and takes the kernel instead. Two
kinds of kernel are attached: `with_kernel` takes one that is written by hand and enters it in a
table of names; `in_one_kernel` has one made of the function itself (`scalars`).
"""

import dataclasses
import functools
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import ClosedJaxpr, JaxprEqn

from planner_jax.lanes import pallas
from planner_jax.lanes.scalars import Unsupported, scalar_kernel
from planner_jax.lanes.walk import shape_of

# A kernel takes the tree of a function's arguments and their leaves, with the lanes last; it gives
# the leaves of the results, or None where it is not made for such shapes.
Kernel = Callable[[Any, Sequence[Array]], list[Array] | None]
# The same for a call in a jaxpr, whose tree of arguments is known.
CallKernel = Callable[[Sequence[Array]], list[Array] | None]


@dataclasses.dataclass
class _Attached:
    """What is known of a name in the table."""

    kernel: CallKernel
    shapes: list[tuple[int, ...]]  # of the leaves of one lane's arguments, then of the results


_KERNELS: dict[str, _Attached] = {}  # by the names of functions that have a kernel
_GENERATED = "in_one_kernel_"  # begins the names of functions whose kernels `scalars` makes
_BLOCK = 32  # lanes of a block of such a kernel


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
    return _attached(function, lambda treedef, _: functools.partial(kernel, treedef), key, jvp)


def _attached(
    function: Callable,
    kernel_for: Callable[[Any, tuple], CallKernel],
    key: Any,
    jvp: Callable | None,
) -> Callable:
    """`with_kernel`, given the kernel for each tree of arguments and shapes of their leaves."""

    @functools.cache
    def compiled(treedef: Any, shapes: tuple) -> Callable:
        # The same name in every process, whatever it did before: kept programs are found by it.
        text = repr((_name_of(function), key, treedef, shapes))
        name = f"kernel_{zlib.crc32(text.encode()):08x}"
        while name in _KERNELS:
            name += "_"
        entry = _KERNELS[name] = _Attached(kernel_for(treedef, shapes), [])

        def named(*leaves: Array) -> Any:
            results = function(*jax.tree.unflatten(treedef, leaves))
            entry.shapes = [*shapes, *(leaf.shape for leaf in jax.tree.leaves(results))]
            return results

        named.__name__ = named.__qualname__ = name
        return jax.jit(named)

    # JAX's own derivative of the named function would bear its name, and get its kernel.
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

    Reverse mode splits a function into a way forward and a way back. Each of the two becomes a
    kernel as well, if only the first argument is differentiated by. `in_one_kernel` is meant for
    arithmetic on arrays of a few numbers: what `scalars` cannot take stays as it is.

    Args:
        static: of the constants, then of pytrees of arrays of ONE lane, to a pytree of arrays.
        constants: hashable. For the same ones there is one kernel: give what does not vary, such
            as a planner, in this way and not by a new function object.
    """
    function = functools.partial(static, *constants)

    # The way back computes anew what it needs of the way forward: quicker than reading it.
    again = jax.checkpoint(function, prevent_cse=False)

    def named(*args: Any) -> Any:
        return again(*args)

    # Both ways keep this name, by which `kernel_of` knows them.
    named.__name__ = named.__qualname__ = _GENERATED + _name_of(static)
    split_by_name = jax.jit(named)

    def kernel_for(treedef: Any, shapes: tuple) -> CallKernel:
        def flat(*leaves: Array) -> list[Array]:
            return jax.tree.leaves(function(*jax.tree.unflatten(treedef, leaves)))

        def kernel(leaves: Sequence[Array]) -> list[Array] | None:
            pairs = zip(shapes, leaves, strict=True)
            one = [jax.ShapeDtypeStruct(shape, leaf.dtype) for shape, leaf in pairs]
            return _generated(jax.make_jaxpr(flat)(*one), leaves)

        return kernel

    def jvp(primals: tuple, tangents: tuple) -> tuple:
        leaves, treedef = jax.tree.flatten(primals)
        directions = jax.tree.leaves(tangents)
        moving = [k for k, t in enumerate(directions) if not isinstance(t, SymbolicZero)]
        only_first = all(k < len(jax.tree.leaves(primals[0])) for k in moving)
        differentiated = split_by_name if only_first and pallas.in_use() else function

        def of_moving(*moved: Array) -> Any:
            every = list(leaves)
            for k, leaf in zip(moving, moved, strict=True):
                every[k] = leaf
            return differentiated(*jax.tree.unflatten(treedef, every))

        return jax.jvp(
            of_moving, tuple(leaves[k] for k in moving), tuple(directions[k] for k in moving)
        )

    return _attached(function, kernel_for, (_name_of(static), constants), jvp)


def kernel_of(eqn: JaxprEqn, closed: ClosedJaxpr, inputs: list[Any]) -> CallKernel | None:
    """The kernel for a call of a function in a jaxpr; None where none is attached to its name.

    Args:
        eqn: the call.
        closed: the function that it calls.
        inputs: of the call: constants that all lanes share, and anything else.
    """
    name = eqn.params.get("name", "")
    if name.startswith(_GENERATED):
        return _generated_for(closed, inputs)
    attached = _KERNELS.get(name)
    if attached is None:
        return None
    # What reverse mode splits off a compiled function keeps its name, but not all its shapes.
    shapes = [shape_of(atom) for atom in (*eqn.invars, *eqn.outvars)]
    is_whole = len(shapes) == len(attached.shapes) and all(
        of_call[len(of_call) - len(of_lane) :] == of_lane
        for of_call, of_lane in zip(shapes, attached.shapes, strict=True)
    )
    return attached.kernel if is_whole else None


def _generated_for(closed: ClosedJaxpr, inputs: list[Any]) -> CallKernel:
    """The kernel that `scalars` makes for a call; inputs with known numbers are built into it."""
    known = [isinstance(x, np.ndarray | Array) and not isinstance(x, Tracer) for x in inputs]

    def kernel(leaves: Sequence[Array]) -> list[Array] | None:
        triples = zip(inputs, leaves, known, strict=True)
        return _generated(closed, [np.asarray(x) if k else leaf for x, leaf, k in triples])

    return kernel


def _generated(closed: ClosedJaxpr, args: Sequence[Any]) -> list[Array] | None:
    """Results of a function of one lane by a kernel that `scalars` makes; None if it cannot."""
    lanes = next((x.shape[-1] for x in args if not isinstance(x, np.ndarray)), 0)
    threads = pallas.block_width(lanes, _BLOCK) if lanes else None
    try:
        return None if threads is None else scalar_kernel(closed, args, threads)
    except Unsupported:
        return None
