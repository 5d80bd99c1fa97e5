"""Penalties integrated along trajectories with pieces of fixed time ratios [Yu2023catch, eq. 26].

The integrals are the innermost part of every search. On a GPU one CUDA kernel (`along_kernel`)
computes them, and keeps the samples of a trajectory in registers. Further kernels compute
derivatives. On other devices JAX compiles the functions of this module.
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

BETWEEN_NODES = 0.004  # typical excess at a peak minus the excess at the nearest sample

# An `Excess` is a function of samples of a motion and of a pytree of numbers. It returns an array
# for each of E limits, with the shape of the motion's height, positive where the limit is exceeded.
Excess = Callable[[Motion, PyTree], tuple[Array, ...]]
# A `Rate` is a function of samples of a motion and of a pytree of numbers: the cost per second.
Rate = Callable[[Motion, PyTree], Array]


@dataclasses.dataclass(frozen=True)
class Along:
    """Constants of a planner that define its penalties for exceeding limits along a trajectory.

    The penalty of a trajectory's segment is the integral over time, by the trapezoid rule at K
    samples, of weighted smoothed hinges of excess + margin for E limits, plus the integral of
    `rate`, if given. C vectors (3,), called columns, and the mean duration h of the polynomial
    pieces determine a segment. Columns are the states at both ends, with the d-th derivative
    multiplied by h^d, and waypoint offsets: scaled deviations from the smoothest trajectory.
    """

    maps: ProportionalMinco
    nodes: int  # number of intervals of each piece
    excess: Excess
    margins: tuple[float, ...]  # (E,), added to each excess before the hinge
    # None: the last two `parameters` are a factor on the margins, and the width, which are known
    # only at run time.
    hinge_width: float | None
    # Cost per second that the user defines (extras of a case). With it no CUDA kernel is used.
    rate: Rate | None = None
    # Number of derivatives on which limits depend: 4 for position to jerk, 5 with the snap.
    orders: int = 4
    # Groups of derivatives (order, axis) that occur together in a limit, for `along_curvature`. The
    # penalty is a sum of functions of one group each. By default all derivatives are one group.
    groups: tuple[tuple[tuple[int, int], ...], ...] = ()
    hinge_weights: tuple[float, ...] = ()  # (E,), weights of the hinges; 1 by default

    def __post_init__(self) -> None:
        if not self.hinge_weights:
            object.__setattr__(self, "hinge_weights", (1.0,) * len(self.margins))
        if not self.groups:
            every = tuple((order, axis) for order in range(self.orders) for axis in range(3))
            object.__setattr__(self, "groups", (every,))

    def __repr__(self) -> str:
        """Return a text of all constants, equal in every process: a key of the compile cache."""
        code = self.excess.__module__, getattr(self.excess, "__qualname__", "")
        pieces = tuple(self.maps.proportions.tolist())
        shape = self.maps.order, pieces, self.maps.coefficients.shape[-1], self.nodes
        hinges = self.margins, self.hinge_width, self.hinge_weights
        return f"Along{(*shape, *code, *hinges, self.rate is None, self.orders)}"

    def split(self, parameters: PyTree) -> tuple[PyTree, Array | float, Array | float]:
        """Split parameters: numbers of the excess, factor on the margins, and hinge width."""
        if self.hinge_width is None:
            *numbers, factor, width = parameters
            return tuple(numbers), factor, width
        return parameters, 1.0, self.hinge_width

    def matrices(self) -> np.ndarray:
        """Return matrices (K, orders, C) from C columns to the motion at K samples.

        Columns are end states and waypoint offsets. The motion has position, velocity, ... for a
        mean piece duration of 1 s.
        """
        each = [self.maps.sample_matrix(self.nodes, d) for d in range(self.orders)]
        return np.stack(each, axis=1)

    def times(self) -> np.ndarray:
        """Return the times (K,) of a segment's K samples, in units of the mean piece duration."""
        steps = np.repeat(self.maps.proportions / self.nodes, self.nodes)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def weights(self) -> np.ndarray:
        """Return the trapezoid weights (K,) of K samples, in units of the mean piece duration."""
        return join_trapezoid_weights(self.nodes, self.maps.proportions)


def integrate_along(
    along: Along, columns: Array, piece_durations: Array, parameters: PyTree
) -> tuple[Array, Array]:
    """Integrate the penalties of N segments, and return the greatest excess of each segment.

    Args:
        along: functions of the excess over limits, and the quadrature.
        columns: (N, C, 3), the columns of each segment: states at its ends, with the d-th
            derivative multiplied by h^d, and waypoint offsets (scaled deviations from the smoothest
            trajectory).
        piece_durations: (N,) [s], mean duration h of the polynomial pieces of each segment.
        parameters: numbers that the excess functions need, such as gravity, for all segments.

    Returns:
        penalties: (N,).
        worst: (N,), the greatest excess at the samples, without a derivative.
    """
    return _integral(along)(columns, piece_durations, parameters)


def greatest_along(
    along: Along, columns: Array, piece_durations: Array, parameters: PyTree
) -> tuple[Array, ...]:
    """Return the greatest excess over each limit along N segments: one array (N,) for each limit.

    `columns` (N, C, 3) are the scaled end states and waypoint offsets of the segments,
    `piece_durations` (N,) [s] the mean durations of their pieces, and `parameters` the numbers that
    the excess functions need. Parabolas estimate peaks between the samples. The result is
    differentiable.
    """
    return _greatest(along)(columns, piece_durations, parameters)


def _with_kernel(
    function: Callable,
    along: Along,
    mode: str,
    jvp: Callable | None = None,
    is_in_rule: bool = False,
) -> Callable:
    path = "planner_jax.cost.along_kernel:along_kernel"
    own = functools.partial(function, along)
    return with_kernel(own, path, along, mode, jvp=jvp, is_in_rule=is_in_rule)


@functools.cache
def _greatest(along: Along) -> Callable:
    greatest = functools.partial(_greatest_of_segments, along)
    return with_kernel(greatest, "planner_jax.cost.peaks_kernel:peaks_kernel", along)


@functools.cache
def _integral(along: Along) -> Callable:
    values = _with_kernel(_values, along, "values")
    slopes = _with_kernel(_slopes, along, "slopes")
    curvature = _with_kernel(_curvature, along, "curvature", is_in_rule=True)

    def slopes_jvp(primals: tuple, tangents: tuple) -> tuple:
        moved = None if _is_still(tangents[2]) else jax.tree.map(_dense, tangents[2])
        return slopes_by_all(*primals), curvature(primals, (*map(_dense, tangents[:2]), moved))

    slopes_by_all = _with_kernel(_slopes_by_all, along, "slopes by all", jvp=slopes_jvp)

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
        # A sample is part of three parabolas; the barrier keeps XLA from computing it three times.
        excess = jax.lax.optimization_barrier(along.excess(motion, parameters))
        return tuple(greatest_by_parabolas(each, along.times()) for each in excess)

    return jax.vmap(of_segment)(columns, durations)


def _values(
    along: Along, columns: Array, durations: Array, parameters: PyTree
) -> tuple[Array, Array]:
    segments = jax.vmap(functools.partial(_of_segment, along), in_axes=(0, 0, None))
    return segments(columns, durations, parameters)


def _slopes(
    along: Along, columns: Array, durations: Array, parameters: PyTree
) -> tuple[Array, ...]:
    value = lambda c, h: _values(along, c, h, parameters)  # noqa: E731
    penalties, pull_back, worst = jax.vjp(value, columns, durations, has_aux=True)
    return penalties, worst, *pull_back(jnp.ones_like(penalties))


def _slopes_by_all(along: Along, columns: Array, durations: Array, parameters: PyTree) -> tuple:
    def of_segment(columns: Array, duration: Array, parameters: PyTree) -> tuple:
        value = functools.partial(_of_segment, along)
        penalty, pull_back, worst = jax.vjp(value, columns, duration, parameters, has_aux=True)
        return penalty, jax.lax.stop_gradient(worst), *pull_back(jnp.ones_like(penalty))

    return jax.vmap(of_segment, in_axes=(0, 0, None))(columns, durations, parameters)


def _curvature(along: Along, primals: tuple, tangents: tuple) -> tuple:
    moves = 2 if tangents[2] is None else 3
    slopes = lambda *moving: _slopes_by_all(along, *moving, *primals[moves:])  # noqa: E731
    return jax.jvp(slopes, primals[:moves], tangents[:moves])[1]


def _contract(slope: Array, tangent: Array) -> Array:
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
    weights = jnp.asarray(along.weights(), columns.dtype)
    margins, factors = (
        jnp.asarray(np.array(each)[:, None], columns.dtype)
        for each in (along.margins, along.hinge_weights)
    )
    numbers, factor, width = along.split(parameters)
    if along.hinge_width is None:
        margins = factor * margins
    motion = sample_motion(along.maps, along.nodes, columns, duration, along.orders)
    each = along.excess(motion, numbers)
    hinges = factors * smooth_hinge(jnp.stack(each) + margins, width)
    penalty = duration * jnp.sum(hinges * weights[None])
    if along.rate is not None:
        penalty = penalty + duration * jnp.sum(along.rate(motion, numbers) * weights)
    # On a CPU, maxima of two arrays in turn are faster than a maximum over stacked arrays.
    return penalty, jnp.max(functools.reduce(jnp.maximum, each))
