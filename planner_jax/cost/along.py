"""Penalties integrated along a trajectory of pieces in fixed proportion [Yu2023catch, eq. 26].

This is the innermost part of every solve. On a GPU one kernel computes it (`along_kernel`), which
keeps the samples of a trajectory in registers; its slopes and their derivatives along a direction
are kernels too. Elsewhere, and for all other derivatives, JAX compiles the functions of this
module, which are the reference of the kernels.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jaxtyping import PyTree

from planner_jax.cost.penalty import greatest_by_parabolas, join_trapezoid_weights, smooth_hinge
from planner_jax.lanes import with_kernel
from planner_jax.trajectory.polynomial import Motion
from planner_jax.trajectory.proportional_minco import ProportionalMinco, sample_motion

BETWEEN_NODES = 0.004  # typical height of peaks between penalty nodes above the nodes

# Takes a motion and any pytree of numbers, and no other array. Returns E arrays of the shape of the
# motion's height, positive where a limit is exceeded.
Excess = Callable[[Motion, PyTree], tuple[Array, ...]]
# Takes the same arguments. Returns the cost per second at each sample.
Rate = Callable[[Motion, PyTree], Array]


@dataclasses.dataclass(frozen=True)
class Along:
    """The integrand and the quadrature of penalties: constants of a planner.

    h is the mean duration of a segment's pieces.
    A segment's penalty is the integral, by the trapezoid rule, of the weighted smoothed hinges of
    excess + margin, plus the integral of the rate if there is one.
    """

    maps: ProportionalMinco
    nodes: int  # intervals a piece
    excess: Excess
    margins: tuple[float, ...]  # (E,), in the unit of each excess
    hinge_width: float
    # Rate of a case's extras. They take the whole position, which kernels do not compute.
    rate: Rate | None = None
    # Derivatives of the motion that the excess takes, position included: 5 with the snap
    orders: int = 4
    # Slots (order, axis) of the motion that occur in common limits, for `along_curvature`: the
    # penalty is a sum of functions of one group each. By default all slots are one group.
    groups: tuple[tuple[tuple[int, int], ...], ...] = ()
    hinge_weights: tuple[float, ...] = ()  # (E,), of the hinges; 1 by default

    def __post_init__(self) -> None:
        if not self.hinge_weights:
            object.__setattr__(self, "hinge_weights", (1.0,) * len(self.margins))
        if not self.groups:
            every = tuple((order, axis) for order in range(self.orders) for axis in range(3))
            object.__setattr__(self, "groups", (every,))

    def __repr__(self) -> str:
        """Return all constants in numbers and names, the same text in every process."""
        code = self.excess.__module__, getattr(self.excess, "__qualname__", "")
        pieces = tuple(self.maps.proportions.tolist())
        shape = self.maps.order, pieces, self.maps.coefficients.shape[-1], self.nodes
        hinges = self.margins, self.hinge_width, self.hinge_weights
        return f"Along{(*shape, *code, *hinges, self.rate is None, self.orders)}"

    def matrices(self) -> np.ndarray:
        """Return maps (K, orders, C) from columns to samples of the motion, for h = 1."""
        each = [self.maps.sample_matrix(self.nodes, d) for d in range(self.orders)]
        return np.stack(each, axis=1)

    def times(self) -> np.ndarray:
        """Return the times (K,) of the samples, for h = 1."""
        steps = np.repeat(self.maps.proportions / self.nodes, self.nodes)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def weights(self) -> np.ndarray:
        """Return quadrature weights (K,) of the samples, for h = 1."""
        return join_trapezoid_weights(self.nodes, self.maps.proportions)


def integrate_along(
    along: Along, columns: Array, piece_durations: Array, parameters: PyTree
) -> tuple[Array, Array]:
    """Integrate the penalties of N segments, and find their greatest excesses.

    Args:
        along: constants.
        columns: (N, C, 3) boundary rows and whitened offsets of each segment.
        piece_durations: (N,) [s], mean duration h of the pieces of each segment.
        parameters: second argument of the excess, the same for all segments.

    Returns:
        penalties: (N,).
        worst: (N,), the greatest excess at the samples, without a derivative.
    """
    return _integral(along)(columns, piece_durations, parameters)


def greatest_along(
    along: Along, columns: Array, piece_durations: Array, parameters: PyTree
) -> tuple[Array, ...]:
    """Return the greatest excess over each limit along N segments, E arrays (N,), differentiable.

    The arguments are the same as for `integrate_along`. Peaks between the samples are estimated by
    parabolas (`penalty.greatest_by_parabolas`).
    """
    return _greatest(along)(columns, piece_durations, parameters)


def _with_kernel(
    function: Callable, along: Along, mode: str, jvp: Callable | None = None
) -> Callable:
    """Bind a function to its constants, with the kernel of a mode."""
    path = "planner_jax.cost.along_kernel:along_kernel"
    return with_kernel(functools.partial(function, along), path, along, mode, jvp=jvp)


@functools.cache
def _greatest(along: Along) -> Callable:
    """Return `greatest_along` for these constants, with a kernel."""
    greatest = functools.partial(_greatest_of_segments, along)
    return with_kernel(greatest, "planner_jax.cost.peaks_kernel:peaks_kernel", along)


@functools.cache
def _integral(along: Along) -> Callable:
    """Return `integrate_along` for these constants, with kernels for it and two derivatives."""
    values = _with_kernel(_values, along, "values")
    slopes = _with_kernel(_slopes, along, "slopes")
    curvature = _with_kernel(_curvature, along, "curvature")

    def slopes_jvp(primals: tuple, tangents: tuple) -> tuple:
        moved = None if _is_still(tangents[2]) else jax.tree.map(_dense, tangents[2])
        direction = (*map(_dense, tangents[:2]), moved)
        return slopes_by_all(*primals), curvature(primals, direction)

    slopes_by_all = _with_kernel(_slopes_by_all, along, "slopes by all", slopes_jvp)

    def values_jvp(primals: tuple, tangents: tuple) -> tuple:
        is_solvers = _is_still(tangents[2])  # the solver changes only columns and durations
        penalties, worst, *by = (slopes if is_solvers else slopes_by_all)(*primals)
        tangents = jax.tree.map(_dense, tangents[: len(by)] if is_solvers else tangents)
        moved = jax.tree.leaves(jax.tree.map(_contract, (*by,), tangents))
        return (penalties, worst), (sum(moved[1:], moved[0]), jnp.zeros_like(worst))

    integral = jax.custom_jvp(lambda *args: values(*args))
    integral.defjvp(values_jvp, symbolic_zeros=True)
    return integral


def _greatest_of_segments(
    along: Along, columns: Array, durations: Array, parameters: PyTree
) -> tuple[Array, ...]:

    def of_segment(columns: Array, duration: Array) -> tuple[Array, ...]:
        motion = sample_motion(along.maps, along.nodes, columns, duration, along.orders)
        # The barrier keeps XLA from computing every sample three times for the peaks.
        excess = jax.lax.optimization_barrier(along.excess(motion, parameters))
        return tuple(greatest_by_parabolas(each, along.times()) for each in excess)

    return jax.vmap(of_segment)(columns, durations)


def _values(
    along: Along, columns: Array, durations: Array, parameters: PyTree
) -> tuple[Array, Array]:
    """Return penalties and greatest excesses, (N,) each."""
    segments = jax.vmap(functools.partial(_of_segment, along), in_axes=(0, 0, None))
    return segments(columns, durations, parameters)


def _slopes(
    along: Along, columns: Array, durations: Array, parameters: PyTree
) -> tuple[Array, ...]:
    """Return `_values`, and slopes of the penalties by columns (N, C, 3) and durations (N,)."""
    value = lambda c, h: _values(along, c, h, parameters)  # noqa: E731
    penalties, pull_back, worst = jax.vjp(value, columns, durations, has_aux=True)
    return penalties, worst, *pull_back(jnp.ones_like(penalties))


def _slopes_by_all(along: Along, columns: Array, durations: Array, parameters: PyTree) -> tuple:
    """Return `_slopes`, and slopes by the parameters of each segment, N in front."""

    def of_segment(columns: Array, duration: Array, parameters: PyTree) -> tuple:
        value = functools.partial(_of_segment, along)
        penalty, pull_back, worst = jax.vjp(value, columns, duration, parameters, has_aux=True)
        return penalty, jax.lax.stop_gradient(worst), *pull_back(jnp.ones_like(penalty))

    segments = jax.vmap(of_segment, in_axes=(0, 0, None))
    return segments(columns, durations, parameters)


def _curvature(along: Along, primals: tuple, tangents: tuple) -> tuple:
    """Return the derivative of `_slopes_by_all` along tangents; parameters are fixed if None."""
    moves = 2 if tangents[2] is None else 3
    slopes = lambda *moving: _slopes_by_all(along, *moving, *primals[moves:])  # noqa: E731
    return jax.jvp(slopes, primals[:moves], tangents[:moves])[1]


def _contract(slope: Array, tangent: Array) -> Array:
    """Return the change of each segment's penalty along a tangent, (N,)."""
    return jnp.sum(slope * tangent, axis=tuple(range(1, slope.ndim)))


def _is_still(tangent: PyTree) -> bool:
    return all(isinstance(leaf, SymbolicZero) for leaf in jax.tree.leaves(tangent))


def _dense(tangent: PyTree) -> PyTree:
    if not isinstance(tangent, SymbolicZero):
        return tangent
    aval: PyTree = tangent.aval
    return jnp.zeros(aval.shape, aval.dtype)


def _of_segment(
    along: Along, columns: Array, duration: Array, parameters: PyTree
) -> tuple[Array, Array]:
    """Return penalty and greatest excess of one segment."""
    weights = jnp.asarray(along.weights(), columns.dtype)
    margins, factors = (
        jnp.asarray(np.array(each)[:, None], columns.dtype)
        for each in (along.margins, along.hinge_weights)
    )
    motion = sample_motion(along.maps, along.nodes, columns, duration, along.orders)
    each = along.excess(motion, parameters)
    hinges = factors * smooth_hinge(jnp.stack(each) + margins, along.hinge_width)
    penalty = duration * jnp.sum(hinges * weights[None])
    if along.rate is not None:
        penalty = penalty + duration * jnp.sum(along.rate(motion, parameters) * weights)
    # First over the limits at each sample: on a CPU faster than a maximum of the stack.
    return penalty, jnp.max(functools.reduce(jnp.maximum, each))
