"""Penalties integrated along a trajectory of pieces in fixed proportion (paper 000, eq. 26).

The innermost part of every solve. On a GPU it is one kernel (`along_kernel`), in which the
samples of a trajectory never leave the registers, and so are its slopes and their derivatives
along a direction; elsewhere, and for all other derivatives, it is what is written here.
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

    def key(self) -> tuple:
        """All of it in numbers and names."""
        code = self.excess.__module__, getattr(self.excess, "__qualname__", "")
        shape = self.maps.order, tuple(self.maps.proportions.tolist()), self.nodes
        return *shape, *code, self.margins, self.hinge_width

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


def greatest_along(
    along: Along, columns: Array, piece_durations: Array, parameters: Any
) -> tuple[Array, ...]:
    """Greatest excess over every limit along N segments; the arguments of `integrate_along`.

    Returns:
        E arrays (N,), differentiable.
    """
    return _greatest(along)(columns, piece_durations, parameters)


@functools.cache
def _greatest(along: Along) -> Callable:
    """`greatest_along`, with a kernel."""

    def of_segment(columns: Array, duration: Array, parameters: Any) -> tuple[Array, ...]:
        motion = sample_motion(along.maps, along.nodes, columns, duration)
        return tuple(jnp.max(excess) for excess in along.excess(motion, parameters))

    segments = jax.vmap(of_segment, in_axes=(0, 0, None))
    return with_kernel(segments, along_kernel(along, "greatest"), along.key())


@functools.cache
def _integral(along: Along) -> Callable:
    """`integrate_along`, with kernels for its values, slopes and curvature."""
    values = functools.partial(_values, along)
    values_in_lanes = with_kernel(values, along_kernel(along, "values"), along.key())

    def slopes(columns: Array, durations: Array, parameters: Any) -> tuple[Array, ...]:
        value: Any = lambda c, h: values(c, h, parameters)  # noqa: E731
        penalties, pull_back, worst = jax.vjp(value, columns, durations, has_aux=True)
        return penalties, worst, *pull_back(jnp.ones_like(penalties))

    slopes_in_lanes = with_kernel(slopes, along_kernel(along, "slopes"), along.key())

    def segment_slopes(columns: Array, duration: Array, parameters: Any) -> tuple:
        value: Any = functools.partial(_of_segment, along)
        penalty, pull_back, worst = jax.vjp(value, columns, duration, parameters, has_aux=True)
        return penalty, jax.lax.stop_gradient(worst), *pull_back(jnp.ones_like(penalty))

    slopes_by_all: Any = jax.vmap(segment_slopes, in_axes=(0, 0, None))

    def curved(primals: tuple, tangents: tuple) -> tuple:
        """Tangents of `slopes_by_all`; None for those of parameters that do not move."""
        *free, given = primals
        if tangents[2] is None:
            return jax.jvp(lambda *x: slopes_by_all(*x, given), tuple(free), tangents[:2])[1]
        return jax.jvp(slopes_by_all, primals, tangents)[1]

    curved_in_lanes = with_kernel(curved, along_kernel(along, "curvature"), along.key())

    def curve(primals: tuple, tangents: tuple) -> tuple:
        given = None if _is_still(tangents[2]) else jax.tree.map(_dense, tangents[2])
        moving = (*map(_dense, tangents[:2]), given)
        return slopes_by_all_in_lanes(*primals), curved_in_lanes(primals, moving)

    slopes_by_all_in_lanes = with_kernel(
        slopes_by_all, along_kernel(along, "slopes by all"), along.key(), curve
    )

    @jax.custom_jvp
    def integral(columns: Array, durations: Array, parameters: Any) -> tuple[Array, Array]:
        return values_in_lanes(columns, durations, parameters)

    def slope(primals: tuple, tangents: tuple) -> tuple:
        still = _is_still(tangents[2])
        tangents = jax.tree.map(_dense, tangents)
        if still:  # which is what the solver asks for
            penalties, worst, *by = slopes_in_lanes(*primals)
            tangents = tangents[:2]
        else:
            penalties, worst, *by = slopes_by_all_in_lanes(*primals)
        moved = jax.tree.leaves(jax.tree.map(_contracted, (*by,), tangents))
        return (penalties, worst), (sum(moved[1:], moved[0]), jnp.zeros_like(worst))

    integral.defjvp(slope, symbolic_zeros=True)
    return integral


def _contracted(slope: Array, tangent: Array) -> Array:
    """What a tangent moves each segment's penalty by, (N,)."""
    return jnp.sum(slope * tangent, axis=tuple(range(1, slope.ndim)))


def _is_still(tangent: Any) -> bool:
    return all(isinstance(leaf, SymbolicZero) for leaf in jax.tree.leaves(tangent))


def _dense(tangent: Any) -> Any:
    if not isinstance(tangent, SymbolicZero):
        return tangent
    aval: Any = tangent.aval
    return jnp.zeros(aval.shape, aval.dtype)


def _values(
    along: Along, columns: Array, piece_durations: Array, parameters: Any
) -> tuple[Array, Array]:
    segments = jax.vmap(functools.partial(_of_segment, along), in_axes=(0, 0, None))
    return segments(columns, piece_durations, parameters)


def _of_segment(
    along: Along, columns: Array, duration: Array, parameters: Any
) -> tuple[Array, Array]:
    weights = jnp.asarray(along.weights(), columns.dtype)
    margins = jnp.asarray(np.array(along.margins)[:, None], columns.dtype)
    motion = sample_motion(along.maps, along.nodes, columns, duration)
    excess = jnp.stack(along.excess(motion, parameters))
    hinges = smoothed_hinge(excess + margins, along.hinge_width)
    return duration * jnp.sum(hinges * weights), jnp.max(excess)
