"""Penalties integrated along a trajectory of pieces in fixed proportion (paper 000, eq. 26).

The innermost part of every solve. On a GPU it is one kernel (`along_kernel`), in which the
samples of a trajectory never leave the registers; elsewhere, and for all derivatives that the
solver does not take, it is what is written here.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from planner_jax.cost.along_kernel import along_kernel
from planner_jax.cost.penalty import joined_trapezoid_weights, smoothed_hinge
from planner_jax.lanes import with_kernel
from planner_jax.trajectory.polynomial import Motion
from planner_jax.trajectory.proportional_minco import ProportionalMinco, sample_motion

# Of a motion and any pytree of numbers: E arrays, each of the shape of the motion's height,
# positive where a limit is exceeded. It must know no other array.
Excess = Callable[[Motion, Any], tuple[Array, ...]]


@dataclasses.dataclass(frozen=True)
class Along:
    """Which penalties are integrated, and how: constants of a planner.

    One segment's penalty is the integral of the sum of smoothed hinges of excess + margin, by
    the trapezoid rule.
    """

    maps: ProportionalMinco
    nodes: int  # intervals a piece
    excess: Excess
    margins: tuple[float, ...]  # (E,), in the unit of each excess
    hinge_width: float

    def matrices(self) -> np.ndarray:
        """Position to jerk at the samples, in time over h, from the columns: (K, 4, C)."""
        return np.stack([self.maps.sample_matrix(self.nodes, d) for d in range(4)], axis=1)

    def weights(self) -> np.ndarray:
        """Of the samples, (K,); times the mean duration of a piece [s]."""
        return joined_trapezoid_weights(self.nodes, self.maps.proportions)


def integrate_along(
    along: Along, columns: Array, piece_durations: Array, parameters: Any
) -> tuple[Array, Array]:
    """Integrated penalties and greatest excesses of N segments.

    Args:
        along: constants.
        columns: (N, C, 3) boundary rows and whitened offsets of each segment.
        piece_durations: (N,) [s], mean of its pieces.
        parameters: that the excess takes, the same for all segments.

    Returns:
        penalties: (N,).
        worst: (N,), the greatest excess at the samples; it has no derivative.
    """
    integral: Any = _integral(along)
    return integral(columns, piece_durations, parameters)


@functools.cache
def _integral(along: Along) -> Callable:
    """`integrate_along`, with a kernel for its values and one for its slopes."""
    values = functools.partial(_values, along)
    values_in_lanes = with_kernel(values, along_kernel(along, slopes=False))

    def slopes(columns: Array, durations: Array, parameters: Any) -> tuple[Array, ...]:
        value = lambda *of: values(*of, parameters)  # noqa: E731
        penalties, pull_back, worst = jax.vjp(value, columns, durations, has_aux=True)
        return penalties, worst, *pull_back(jnp.ones_like(penalties))

    slopes_in_lanes = with_kernel(slopes, along_kernel(along, slopes=True))

    @jax.custom_jvp
    def integral(columns: Array, durations: Array, parameters: Any) -> tuple[Array, Array]:
        return values_in_lanes(columns, durations, parameters)

    def jvp(primals: tuple, tangents: tuple) -> tuple:
        constant = all(isinstance(x, SymbolicZero) for x in jax.tree.leaves(tangents[2]))
        tangents = jax.tree.map(_dense, tangents)
        if constant:  # the parameters do not move, which is what the solver asks for
            penalties, worst, by_columns, by_duration = slopes_in_lanes(*primals)
            moved = jnp.sum(by_columns * tangents[0], axis=(1, 2)) + by_duration * tangents[1]
        else:
            penalties, moved, worst = jax.jvp(values, primals, tangents, has_aux=True)
        return (penalties, worst), (moved, jnp.zeros_like(worst))

    integral.defjvp(jvp, symbolic_zeros=True)
    return integral


def _dense(tangent: Any) -> Any:
    if not isinstance(tangent, SymbolicZero):
        return tangent
    aval: Any = tangent.aval
    return jnp.zeros(aval.shape, aval.dtype)


def _values(
    along: Along, columns: Array, piece_durations: Array, parameters: Any
) -> tuple[Array, Array]:
    weights = jnp.asarray(along.weights(), columns.dtype)
    margins = jnp.asarray(np.array(along.margins)[:, None], columns.dtype)

    def segment(own: Array, duration: Array) -> tuple[Array, Array]:
        motion = sample_motion(along.maps, along.nodes, own, duration)
        excess = jnp.stack(along.excess(motion, parameters))
        hinges = smoothed_hinge(excess + margins, along.hinge_width)
        return duration * jnp.sum(hinges * weights), jnp.max(excess)

    return jax.vmap(segment)(columns, piece_durations)
