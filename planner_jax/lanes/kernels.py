"""The functions that have a CUDA kernel for batches, and the switch for all kernels.

A lane is one problem of a batch. `jax.jit` compiles each function with a kernel under a unique
name, since only names survive all transformations. `over_lanes` finds a call with such a name
and calls the kernel for all lanes instead. Kernels are imported when a program for a GPU is traced.
"""

import dataclasses
import enum
import functools
import importlib
import os
import pkgutil
import zlib
from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend.core import JaxprEqn

from planner_jax.core.choices import require_one_of
from planner_jax.core.compiled import Treedef, traced_platform

SWITCH = "PLANNER_JAX_KERNELS"

Results = TypeVar("Results")
Shape = tuple[int, ...]
# A kernel takes the leaves of a function's arguments, with the lanes (problems) on the last axis.
# It returns the leaves of the results, or None if it does not support the leaves' shapes or types.
Kernel = Callable[[Sequence[Array]], Sequence[Array] | None]


class Kernels(enum.Enum):
    """State whether programs use the library's own CUDA kernels; users read the values as texts."""

    ON = "on"
    OFF = f"off, by {SWITCH}"
    MISSING = "unavailable: this JAX lacks Pallas' Triton backend; plans are slower, but the same"


def kernels() -> Kernels:
    """Return whether CUDA programs use kernels; raise if PLANNER_JAX_KERNELS has a wrong value."""
    if not is_switched_on():
        return Kernels.OFF
    return Kernels.ON if _has_triton() else Kernels.MISSING


def in_use() -> bool:
    """Return whether functions that JAX traces use CUDA kernels, which need Triton and a GPU."""
    return is_switched_on() and has_gpu() and _has_triton()


def is_on_gpu() -> bool:
    """Return whether the program that is being traced runs on a GPU."""
    platform = traced_platform()
    return has_gpu() if platform is None else platform != "cpu"


def has_gpu() -> bool:
    """Return whether a GPU is JAX's default device."""
    return jax.default_backend() == "gpu"


def is_switched_on() -> bool:
    """Return whether PLANNER_JAX_KERNELS is "on" or not set; raise if it is not on or off."""
    value = os.environ.get(SWITCH, "on")
    require_one_of(("on", "off"), SWITCH, value)
    return value == "on"


def _has_triton() -> bool:
    try:
        importlib.import_module("planner_jax.lanes.pallas")
    except ImportError:
        return False
    return True


@dataclasses.dataclass
class _Entry:
    path: str
    constants: tuple[Hashable, ...]
    treedef: Treedef  # tree structure of the function's arguments
    shapes: list[Shape]  # of the leaves of arguments and results of one lane (problem)


_ENTRIES: dict[str, _Entry] = {}  # by the names under which JAX compiles the functions


def with_kernel(
    function: Callable[..., Results],
    path: str,
    *constants: Hashable,
    jvp: Callable[[tuple, tuple], tuple[Results, Results]] | None = None,
    is_in_rule: bool = False,
) -> Callable[..., Results]:
    """Attach a kernel to a function of one problem; `over_lanes` calls it for a batch on a GPU.

    Args:
        function: takes pytrees of arrays of ONE lane (problem), and returns a pytree of arrays.
        path: "module:name" of a factory of kernels, which takes the constants. A kernel takes the
            tree of the arguments and their leaves with the lanes last. It returns the leaves of the
            results, or None if it does not support the shapes; then `function` is evaluated.
            `jax.vmap` within a lane may only add axes in front of leaves, else `function` is
            evaluated.
        constants: arguments of the factory. Functions of one path with different constants must
            have a different `repr` of them, which identifies programs in the compile cache.
        jvp: derivative as for `jax.custom_jvp`, with zeros as `SymbolicZero`; by default JAX's own.
        is_in_rule: whether the function is called in the `jvp` of another one, with the tangents
            as arguments. It then has no rule of its own, since JAX 0.12 cannot transpose one there.
    """

    @functools.cache
    def compile_named(treedef: Treedef, shapes: tuple[Shape, ...]) -> Callable[..., Results]:
        text = repr((path, constants, treedef, shapes))
        name = f"kernel_{zlib.crc32(text.encode()):08x}"
        while name in _ENTRIES:
            name += "_"
        entry = _ENTRIES[name] = _Entry(path, constants, treedef, [])

        def call(*leaves: Array) -> Results:
            results = function(*jax.tree.unflatten(treedef, leaves))
            entry.shapes = [*shapes, *(leaf.shape for leaf in jax.tree.leaves(results))]
            return results

        call.__name__ = call.__qualname__ = name
        return jax.jit(call)

    def call_compiled(*args: object) -> Results:
        leaves, treedef = jax.tree.flatten(args)
        return compile_named(treedef, tuple(map(jnp.shape, leaves)))(*leaves)

    if is_in_rule:
        return call_compiled
    # Differentiate `function`, since a derivative of the compiled function would have its name, and
    # `over_lanes` would replace the derivative by the kernel.
    call_named = jax.custom_jvp(call_compiled)
    if jvp is None:
        call_named.defjvp(lambda primals, tangents: jax.jvp(function, primals, tangents))
    else:
        call_named.defjvp(jvp, symbolic_zeros=True)
    return call_named


def shape_of(atom: Any) -> Shape:
    """Return the shape of a variable or literal of a jaxpr."""
    return atom.aval.shape


def kernel_of(eqn: JaxprEqn) -> Kernel | None:
    """Return the kernel for a call in a jaxpr, or None if the called function has no kernel."""
    entry = _ENTRIES.get(eqn.params.get("name", ""))
    if entry is None:
        return None
    # Reverse-mode differentiation splits a function into two functions with the same name, but
    # other arguments or results. These two functions have no kernel.
    shapes = [shape_of(atom) for atom in (*eqn.invars, *eqn.outvars)]
    is_whole = len(shapes) == len(entry.shapes) and all(
        of_call[len(of_call) - len(of_lane) :] == of_lane
        for of_call, of_lane in zip(shapes, entry.shapes, strict=True)
    )
    if not is_whole:
        return None
    return functools.partial(pkgutil.resolve_name(entry.path)(*entry.constants), entry.treedef)
