"""The only module that imports Pallas, JAX's language for kernels.

Kernels are written for Pallas' Triton backend. When JAX removes it, what has to be rewritten is
this file (docs/lanes_and_kernels.md).
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

# Shape of a block, None for an axis that it does not have; and its index, counted in blocks, as
# a function of the index in the grid.
Block = tuple[tuple[int | None, ...], Callable[..., tuple]]

_FEWEST = 16  # lanes that are worth a block of a kernel


def block_width(lanes: int, most: int) -> int | None:
    """Return the lanes of a kernel's block; None where they would be too few to be worth one.

    Args:
        lanes: of all blocks together, which the width divides evenly.
        most: largest width, a power of two.
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
        body: of references to a block of each input, then of each output, which it writes.
        grid: its size along each axis.
        inputs: the block of every input.
        outputs: shape, type and block of every output.
        name: of the kernel, in profiles and compiled programs.
        threads: that carry out the body.
        in_place: so many of the first inputs are overwritten by the outputs of the same index.
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
    """Make a `kernel_call` in float32, each block of which has all numbers of `width` lanes.

    Args:
        body: as for `kernel_call`.
        inputs: shapes of the inputs without the lanes, which are their last axis.
        outputs: shapes of the outputs without the lanes.
        lanes: of all blocks together.
        width: lanes of a block.
        name: as for `kernel_call`.
        threads: that carry out the body; by default one a lane.
        in_place: as for `kernel_call`.
        interpret: as for `kernel_call`.
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
    """Lower a kernel in two thirds of the time.

    For every value that MLIR passes to Python, it imports a module of Triton's dialect, which
    jaxlib does not ship: thousands of searches of the path, unless an empty module is there.
    """
    name = "jaxlib.mlir.dialects.tt"
    if name not in sys.modules and importlib.util.find_spec(name) is None:
        sys.modules[name] = types.ModuleType(name)
