"""The compiled programs that solve lanes, by one attempt each."""

import functools
from collections.abc import Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from planner_jax.core.protocol import Attempt, is_unsolved, marked
from planner_jax.core.rules import require_shapes
from planner_jax.host.threads import as_here
from planner_jax.planning.layout import (
    LANES,
    apart,
    calls_of,
    length,
    on_devices,
    sharding,
    sizes_of,
)

# XLA tries its own kernels for every product of matrices, a third of the time that a GPU's program
# takes to compile; the library's are as quick for products of such shapes. No effect on a CPU.
_COMPILER_OPTIONS: Any = {"xla_gpu_enable_triton_gemm": False}
COMPILED: set[Hashable] = set()  # what `program_of` names of the programs that have been called


def solve_cases(planner: Any, cases: Any, attempt: Attempt) -> Any:
    """The plans of one case, or of a batch with a leading axis on every leaf; pure.

    All that is planned in compiled programs is planned here: what breaks a rule of its case's
    class is `BAD_INPUT`, whatever the planner makes of it.
    """
    require_shapes(cases)
    if cases.batch_shape == ():
        plans = planner.solve(cases, attempt)
    else:
        plans = planner.solve_lanes(cases, attempt)
    return marked(plans, cases)


@functools.partial(jax.jit, static_argnames=("attempt", "mesh"), compiler_options=_COMPILER_OPTIONS)
def solve_on_devices(planner: Any, attempt: Attempt, mesh: Mesh, cases: Any) -> tuple[Any, Array]:
    """One attempt at the lanes of every device, and how many each leaves unsolved, (devices,)."""

    def solve(planner: Any, cases: Any) -> tuple[Any, Array]:
        return counted(solve_cases(planner, cases, attempt))

    return apart(mesh, solve, PartitionSpec(), LANES)(planner, cases)


def counted(plans: Any) -> tuple[Any, Array]:
    """The plans, and how many are unsolved, (1,)."""
    return plans, jnp.sum(is_unsolved(plans.status), keepdims=True)


def program_of(planner: Any, attempt: Attempt, num: int, cases: Any) -> Hashable:
    """What tells a compiled `solve_on_devices` of so many lanes apart from the others."""
    own = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(planner))
    given = tuple((leaf.shape[1:], leaf.dtype) for leaf in jax.tree.leaves(cases))
    return jax.tree.structure((planner, cases)), own, given, attempt, num


def compile_at_once(planner: Any, attempts: Sequence[Attempt], cases: Any) -> Any:
    """Try all attempts at the first of B cases, each in a thread of its own.

    Afterwards the programs are compiled that `plan_batch` takes for as many on all local devices.

    Args:
        planner: that makes them.
        attempts: one or more.
        cases: a leading axis of B on every leaf.

    Returns:
        What the first attempt makes of the cases, (B, ...) or the first of them.
    """
    planner, mesh = on_devices(planner, None)
    cases = jax.tree.map(np.asarray, cases)

    def tried(attempt: Attempt) -> Any:
        (lanes, num), *_ = calls_of(
            np.arange(length(cases)), sizes_of(planner, attempt, None, mesh), mesh
        )
        part = jax.device_put(jax.tree.map(lambda leaf: leaf[lanes], cases), sharding(mesh))
        found, _ = solve_on_devices(planner, attempt, mesh, part)
        COMPILED.add(program_of(planner, attempt, lanes.size // mesh.size, cases))
        return jax.tree.map(lambda leaf: leaf[:num], found)

    with ThreadPoolExecutor(len(attempts)) as pool:
        first, *_ = pool.map(as_here(tried), attempts)
    return first
