"""The one door to Pallas, JAX's language for kernels, and the switch for all kernels.

Kernels are written for Pallas' Triton backend. No other module imports it: when JAX takes it
away, what has to be written anew is this file (docs/lanes_and_kernels.md).
"""

import enum
import importlib.util
import math
import os
import sys
import types
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

SWITCH = "PLANNER_JAX_KERNELS"

# Shape of a block, None for an axis that it does not have; and its place, counted in blocks, as
# a function of the place in the grid.
Block = tuple[tuple[int | None, ...], Callable[..., tuple]]

_FEWEST = 16  # lanes that are worth a block of a kernel


class Kernels(enum.Enum):
    """Whether programs for CUDA have kernels, in words."""

    ON = "on"
    OFF = f"off, by {SWITCH}"
    MISSING = "unavailable: this JAX lacks Pallas' Triton backend; plans are slower, but the same"


def kernels() -> Kernels:
    """Whether programs for CUDA have kernels.

    Raises:
        ValueError: the environment variable PLANNER_JAX_KERNELS is neither "on" nor "off".
    """
    if not is_switched_on():
        return Kernels.OFF
    return Kernels.ON if _has_triton() else Kernels.MISSING


def in_use() -> bool:
    """Whether a function that is traced now gets its kernels. Raises as `kernels`."""
    return is_switched_on() and has_gpu() and _has_triton()


def has_gpu() -> bool:
    """Whether JAX compiles for a GPU unless it is told otherwise."""
    return jax.default_backend() == "gpu"


def is_switched_on() -> bool:
    """Whether the environment variable asks for kernels. Raises as `kernels`."""
    value = os.environ.get(SWITCH, "on")
    if value not in ("on", "off"):
        raise ValueError(f"{SWITCH} must be one of on, off, got {value!r}")
    return value == "on"


def _has_triton() -> bool:
    """Whether JAX has all that is imported from its Triton backend below."""
    try:
        from jax.experimental.pallas.triton import CompilerParams, load, store  # noqa: F401
    except ImportError:
        return False
    return True


def block_width(lanes: int, most: int) -> int | None:
    """Lanes of a kernel's block: `most`, a power of two, or as many as divide all lanes evenly.

    None where that would be too few to be worth a block.
    """
    width = math.gcd(lanes, most)
    return width if width >= _FEWEST else None


def kernel_call(
    body: Callable,
    grid: tuple[int, ...],
    inputs: Sequence[Block],
    outputs: Sequence[tuple[tuple[int, ...], Any, Block]],
    *,
    name: str,
    threads: int,
    in_place: int = 0,
    interpret: bool = False,
) -> Callable[..., list[Array]]:
    """A kernel: a function of arrays that runs a body once for every place of a grid.

    Args:
        body: of references to a block of each input, then of each output, which it writes.
        grid: its size along each axis.
        inputs: the block of every input.
        outputs: shape, type and block of every output.
        name: of the kernel, in profiles and compiled programs.
        threads: that carry out the body.
        in_place: so many of the first inputs are overwritten by the outputs of the same place.
        interpret: run it without a GPU, for tests.
    """
    from jax.experimental import pallas
    from jax.experimental.pallas.triton import CompilerParams

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
    body: Callable,
    inputs: Sequence[tuple[int, ...]],
    outputs: Sequence[tuple[int, ...]],
    lanes: int,
    width: int,
    **options: Any,
) -> Callable[..., list[Array]]:
    """A `kernel_call` in float32, each block of which has all numbers of `width` of the lanes.

    Args:
        body: as that of `kernel_call`.
        inputs: shapes of the inputs without the lanes, which are their last axis.
        outputs: those of the outputs.
        lanes: of all blocks together.
        width: lanes of a block.
        options: the keywords of `kernel_call`; a lane is carried by one thread if `threads` does
            not say otherwise.
    """

    def block(shape: tuple[int, ...]) -> Block:
        return (*shape, width), lambda i: (*(0 for _ in shape), i)

    return kernel_call(
        body,
        (lanes // width,),
        [block(shape) for shape in inputs],
        [((*shape, lanes), jnp.float32, block(shape)) for shape in outputs],
        **{"threads": width, **options},
    )


def load(ref: Any, index: tuple, mask: Array | None = None) -> Array:
    """Entries of a reference at arrays of places; 0 where the mask is False."""
    from jax.experimental.pallas import triton

    return triton.load(ref.at[index], mask=mask, other=None if mask is None else 0.0)


def store(ref: Any, index: tuple, value: Array, mask: Array) -> None:
    """Write entries of a reference at arrays of places, where the mask is True."""
    from jax.experimental.pallas import triton

    triton.store(ref.at[index], value, mask=mask)


def place_in_grid(axis: int) -> Array:
    """The place along an axis of the grid at which a body runs."""
    from jax.experimental import pallas

    return pallas.program_id(axis)


def _spare_searches() -> None:
    """Have a kernel lowered in two thirds of the time.

    For every value that it hands to Python, MLIR imports a module of Triton's dialect, which
    jaxlib does not ship: thousands of searches of the path, unless an empty module is there.
    """
    name = "jaxlib.mlir.dialects.tt"
    if name not in sys.modules and importlib.util.find_spec(name) is None:
        sys.modules[name] = types.ModuleType(name)
