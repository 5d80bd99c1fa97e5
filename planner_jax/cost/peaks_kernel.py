"""A CUDA kernel for `greatest_along`: the greatest excess over each limit, for many lanes.

A lane is one problem of a batch. One thread computes one lane, as in `along_kernel`. It computes
the samples one after another, and evaluates the parabola through each three neighbours.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, Ref

from planner_jax.core.compiled import Treedef
from planner_jax.cost.along import Along
from planner_jax.cost.along_kernel import (
    Grid,
    call_on_grid,
    grid_of,
    load_numbers,
    load_row,
    sample_excess,
    unit_motion,
)
from planner_jax.cost.penalty import peak_above
from planner_jax.lanes.pallas import grid_index


def peaks_kernel(
    along: Along, *, interpret: bool = False
) -> Callable[[Treedef, Sequence[Array]], Sequence[Array] | None]:
    """Make the kernel for the greatest excess over each limit; `interpret` needs no GPU."""

    def kernel(treedef: Treedef, leaves: Sequence[Array]) -> Sequence[Array] | None:
        columns, durations, *parameters = leaves
        found = grid_of(along, leaves, [(columns, durations, parameters)])
        if found is None:
            return None
        grid, lead = found
        flat = grid.flatten(columns, lead, grid.num_columns, 3), grid.flatten(durations, lead)
        shares = _call(along, interpret, treedef, grid)(*flat, *parameters)
        return [jnp.max(share, axis=0).reshape(*lead, grid.lanes) for share in shares]

    return kernel


@functools.cache
def _call(
    along: Along, interpret: bool, treedef: Treedef, grid: Grid
) -> Callable[..., Sequence[Array]]:
    matrices, steps = along.matrices(), np.diff(along.times())
    num_samples, num = len(matrices), len(along.margins)
    share = -(-num_samples // grid.shares)

    def body(*refs: Ref) -> None:
        leaves = [load_numbers(ref) for ref in refs[: treedef.num_leaves]]
        matrices_ref, steps_ref, *out = refs[treedef.num_leaves :]
        columns, duration, given = jax.tree.unflatten(treedef, leaves)
        begin = grid_index(2) * share
        # Each thread also computes its neighbours' nearest samples, which its parabolas need.
        first = jnp.maximum(begin - 1, 0)
        last = jnp.minimum(begin + share + 1, num_samples)

        def add_sample(k: Array, carry: tuple) -> tuple:
            most, before, middle = carry
            unit = unit_motion(load_row(matrices_ref, k, grid.num_columns), columns)
            values = sample_excess(along, unit, duration, given)
            gaps = steps_ref[jnp.maximum(k - 2, 0)], steps_ref[jnp.maximum(k - 1, 0)]
            for i, value in enumerate(values):
                rise = peak_above(before[i], middle[i], value, *gaps)
                peak = jnp.where(k >= first + 2, middle[i] + rise, value)
                most = [*most[:i], jnp.maximum(most[i], jnp.maximum(value, peak)), *most[i + 1 :]]
            return most, middle, list(values)

        none = [jnp.zeros_like(duration)] * num
        least = [jnp.full_like(duration, -jnp.inf)] * num
        most, _, _ = jax.lax.fori_loop(first, last, add_sample, (least, none, none))
        for ref, value in zip(out, most, strict=True):
            ref[...] = value

    constants = matrices.reshape(num_samples, -1), steps
    shapes = [()] * num
    return call_on_grid(body, grid, shapes, constants, name="greatest_along", interpret=interpret)
