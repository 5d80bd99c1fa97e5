"""The only module that imports Pallas, JAX's language for kernels.

Kernels use Pallas' Triton backend. When JAX removes it, this is the only module to rewrite
(docs/lanes_and_kernels.md).
"""

import importlib.util
import math
import sys
import types
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import Array, Ref
from jax.experimental import pallas
from jax.experimental.pallas.triton import CompilerParams, load, store
from jax.typing import DTypeLike

# Shape of a block, None for an axis that it lacks; and its index, counted in blocks, as a function
# of the index in the grid.
Block = tuple[tuple[int | None, ...], Callable[..., tuple]]

_FEWEST = 16  # least lanes of a block of a kernel


def block_width(lanes: int, most: int) -> int | None:
    """Return the width of a kernel's block in lanes, or None if it would be too small.

    The width divides the number of lanes, and is at most `most`, a power of two.
    """
    width = math.gcd(lanes, most)
    return width if width >= _FEWEST else None


def kernel_call(
    body: Callable[..., None],
    grid: tuple[int, ...],
    inputs: Sequence[Block],
    outputs: Sequence[tuple[tuple[int, ...], DTypeLike, Block]],
    *,
    name: str,
    threads: int,
    in_place: int = 0,
    interpret: bool = False,
) -> Callable[..., Sequence[Array]]:
    """Make a kernel: a function of arrays that runs a body once for every index of a grid.

    Args:
        body: takes references to a block of each input, then of each output, which it writes.
        grid: size along each axis.
        inputs: block of every input.
        outputs: shape, type and block of every output.
        name: name of the kernel in profiles and compiled programs.
        threads: threads that run the body.
        in_place: number of first inputs that the outputs of the same index overwrite.
        interpret: run it without a GPU, for tests.
    """
    _spare_searches()
    return pallas.pallas_call(
        body,
        out_shape=[jax.ShapeDtypeStruct(shape, dtype) for shape, dtype, _ in outputs],
        grid=grid,
        in_specs=[pallas.BlockSpec(*block) for block in inputs],
        out_specs=[pallas.BlockSpec(*block) for *_, block in outputs],
        input_output_aliases={k: k for k in range(in_place)},
        compiler_params=CompilerParams(num_warps=max(threads // 32, 1), num_stages=1),
        interpret=interpret,
        name=name,
    )


def kernel_by_lanes(
    body: Callable[..., None],
    inputs: Sequence[tuple[int, ...]],
    outputs: Sequence[tuple[int, ...]],
    lanes: int,
    width: int,
    *,
    name: str,
    threads: int | None = None,
    in_place: int = 0,
    interpret: bool = False,
) -> Callable[..., Sequence[Array]]:
    """Make a `kernel_call` in float32 whose blocks hold all numbers of `width` lanes.

    `inputs` and `outputs` are shapes without the lanes, which are the last axis. There is one
    thread for each lane by default. The other arguments are as for `kernel_call`.
    """

    def block(shape: tuple[int, ...]) -> Block:
        return (*shape, width), lambda i: (*(0 for _ in shape), i)

    return kernel_call(
        body,
        (lanes // width,),
        [block(shape) for shape in inputs],
        [((*shape, lanes), jnp.float32, block(shape)) for shape in outputs],
        name=name,
        threads=threads or width,
        in_place=in_place,
        interpret=interpret,
    )


def load_masked(ref: Ref, index: tuple, mask: Array) -> Array:
    """Read entries of a reference at arrays of indices; 0 where the mask is False."""
    return load(ref.at[index], mask=mask, other=0.0)


def store_masked(ref: Ref, index: tuple, value: Array, mask: Array) -> None:
    """Write entries of a reference at arrays of indices, where the mask is True."""
    store(ref.at[index], value, mask=mask)


def grid_index(axis: int) -> Array:
    """Return the index along an axis of the grid at which a body runs."""
    return pallas.program_id(axis)


def _spare_searches() -> None:
    """Reduce the time to lower a kernel by a third.

    For every value that MLIR passes to Python, it imports a module of Triton's dialect that jaxlib
    does not contain. An empty module saves thousands of searches of the path.
    """
    name = "jaxlib.mlir.dialects.tt"
    if name not in sys.modules and importlib.util.find_spec(name) is None:
        sys.modules[name] = types.ModuleType(name)
