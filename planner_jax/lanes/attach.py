"""Kernels for functions of one lane: how they are attached, and how `over_lanes` finds them.

A function with a kernel is compiled under a name of its own (`jax.jit`), which it keeps inside
any larger function. `over_lanes` sees the call of that name and calls the kernel instead.
"""

import dataclasses
import functools
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend.core import JaxprEqn

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


def with_kernel(
    function: Callable, kernel: Kernel, key: Any = None, jvp: Callable | None = None
) -> Callable:
    """Attach a kernel to a function; `over_lanes` calls it where the program is for CUDA.

    Args:
        function: of pytrees of arrays of ONE lane, to a pytree of arrays.
        kernel: the same on lanes. `jax.vmap` within a lane adds axes in front of some leaves;
            where it has put one elsewhere, as after a matrix product, no kernel is called.
        key: constants that tell the function from others of its code, by their `repr`.
        jvp: its derivative as `jax.custom_jvp` takes it, zeros as `SymbolicZero`; without it,
            the function's own.
    """

    @functools.cache
    def compiled(treedef: Any, shapes: tuple) -> Callable:
        # The same name in every process, whatever it did before: kept programs are found by it.
        text = repr((_name_of(function), key, treedef, shapes))
        name = f"kernel_{zlib.crc32(text.encode()):08x}"
        while name in _KERNELS:
            name += "_"
        entry = _KERNELS[name] = _Attached(functools.partial(kernel, treedef), [])

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


def kernel_of(eqn: JaxprEqn) -> CallKernel | None:
    """Return the kernel for a call in a jaxpr; None where none is attached to its name."""
    attached = _KERNELS.get(eqn.params.get("name", ""))
    if attached is None:
        return None
    # What reverse mode splits off a compiled function keeps its name, but not all its shapes.
    shapes = [shape_of(atom) for atom in (*eqn.invars, *eqn.outvars)]
    is_whole = len(shapes) == len(attached.shapes) and all(
        of_call[len(of_call) - len(of_lane) :] == of_lane
        for of_call, of_lane in zip(shapes, attached.shapes, strict=True)
    )
    return attached.kernel if is_whole else None
