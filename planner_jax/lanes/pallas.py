"""Helpers for CUDA kernels: the only module that imports Pallas, JAX's language for kernels."""

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

# The part of an array that one run of a kernel's body accesses: its shape (None: an axis that the
# body does not see), and a function from the run's index in the grid to the block's index.
Block = tuple[tuple[int | None, ...], Callable[..., tuple]]

_FEWEST = 16  # least number of lanes (problems of a batch) in a block of a kernel


def block_width(lanes: int, most: int) -> int | None:
    """Return the number of lanes (problems) in a GPU block, gcd(lanes, most); None if below 16."""
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
        body: takes references to a block of each input and of each output, and writes the outputs.
        grid: number of indices along each axis.
        inputs: the block of every input.
        outputs: the shape, type and block of every output.
        name: name of the kernel in profiles and compiled programs.
        threads: number of threads that run the body.
        in_place: number of first inputs that the outputs of the same index overwrite.
        interpret: whether to run the kernel without a GPU, for tests.
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
    """Make a `kernel_call` in float32 whose blocks contain all numbers of `width` lanes (problems).

    `inputs` and `outputs` are the arrays' shapes without the last axis, the lanes. `threads` is by
    default one for each lane of a block. The first `in_place` inputs are overwritten by the
    outputs, and `interpret` runs the kernel without a GPU.
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
    """Read entries of an array in GPU memory at indices; return 0 where the mask is False."""
    return load(ref.at[index], mask=mask, other=0.0)


def store_masked(ref: Ref, index: tuple, value: Array, mask: Array) -> None:
    """Write entries of an array in GPU memory at indices, where the mask is True."""
    store(ref.at[index], value, mask=mask)


def grid_index(axis: int) -> Array:
    """Return the index along an axis of the grid at which the kernel's body is running."""
    return pallas.program_id(axis)


def _spare_searches() -> None:
    """Register the missing module `tt` as empty; else JAX searches for it at every kernel."""
    name = "jaxlib.mlir.dialects.tt"
    if name not in sys.modules and importlib.util.find_spec(name) is None:
        sys.modules[name] = types.ModuleType(name)
