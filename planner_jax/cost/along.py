"""Penalties integrated along a trajectory of pieces in fixed proportion [Yu2023catch, eq. 26].

The innermost part of every solve. On a GPU it is one kernel (`along_kernel`), in which the
samples of a trajectory never leave the registers; its slopes are another kernel, and so are their
derivatives along a direction. Elsewhere, and for all other derivatives, JAX compiles the functions
of this file, which are the kernels' reference.
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

from planner_jax.cost.penalty import greatest_by_parabolas, joined_trapezoid_weights, smoothed_hinge
from planner_jax.lanes import with_kernel
from planner_jax.trajectory.polynomial import Motion
from planner_jax.trajectory.proportional_minco import ProportionalMinco, sample_motion

BETWEEN_NODES = 0.004  # by which peaks between penalty nodes are higher, about

# Of a motion and any pytree of numbers: E arrays, each of the shape of the motion's height,
# positive where a limit is exceeded. It must know no other array.
Excess = Callable[[Motion, PyTree], tuple[Array, ...]]
# Of the same: a cost a second at each sample.
Rate = Callable[[Motion, PyTree], Array]


@dataclasses.dataclass(frozen=True)
class Along:
    """Which penalties are integrated, and how: constants of a planner.

    One segment's penalty is the integral of the weighted sum of smoothed hinges of excess +
    margin, by the trapezoid rule, and that of the rate if there is one.
    """

    maps: ProportionalMinco
    nodes: int  # intervals a piece
    excess: Excess
    margins: tuple[float, ...]  # (E,), in the unit of each excess
    hinge_width: float
    # Of a case's extras. They look at the whole position, and are not made for a kernel.
    rate: Rate | None = None
    orders: int = 4  # of the motion that the excess takes: 5 with the snap
    # Places (order, axis) of the motion that limits look at together, for `along_curvature`: in
    # those of different groups the penalties are a sum. By default everything together.
    groups: tuple[tuple[tuple[int, int], ...], ...] = ()
    hinge_weights: tuple[float, ...] = ()  # (E,), of the hinges; by default one each

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
        """Position and derivatives at the samples, in time over h, from columns: (K, orders, C)."""
        each = [self.maps.sample_matrix(self.nodes, d) for d in range(self.orders)]
        return np.stack(each, axis=1)

    def times(self) -> np.ndarray:
        """Of the samples, in time over h, (K,)."""
        steps = np.repeat(self.maps.proportions / self.nodes, self.nodes)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def weights(self) -> np.ndarray:
        """Of the samples, (K,); times the mean duration of a piece [s]."""
        return joined_trapezoid_weights(self.nodes, self.maps.proportions)


def integrate_along(
    along: Along, columns: Array, piece_durations: Array, parameters: PyTree
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
    return _integral(along)(columns, piece_durations, parameters)


def greatest_along(
    along: Along, columns: Array, piece_durations: Array, parameters: PyTree
) -> tuple[Array, ...]:
    """Greatest excess over every limit along N segments; the arguments of `integrate_along`.

    Peaks between the samples are those of parabolas (`penalty.greatest_by_parabolas`).

    Returns:
        E arrays (N,), differentiable.
    """
    return _greatest(along)(columns, piece_durations, parameters)


def _with_kernel(
    function: Callable, along: Along, mode: str, jvp: Callable | None = None
) -> Callable:
    """Bind a function of constants and arguments to constants, with the kernel of a mode."""
    path = "planner_jax.cost.along_kernel:along_kernel"
    return with_kernel(functools.partial(function, along), path, along, mode, jvp=jvp)


@functools.cache
def _greatest(along: Along) -> Callable:
    """Return `greatest_along` of these constants, with a kernel."""
    greatest = functools.partial(_greatest_of_segments, along)
    return with_kernel(greatest, "planner_jax.cost.peaks_kernel:peaks_kernel", along)


@functools.cache
def _integral(along: Along) -> Callable:
    """`integrate_along`, with kernels for its values, its slopes and their derivatives."""
    values = _with_kernel(_values, along, "values")
    slopes = _with_kernel(_slopes, along, "slopes")
    curvature = _with_kernel(_curvature, along, "curvature")

    def derived_slopes(primals: tuple, tangents: tuple) -> tuple:
        """Slopes by all arguments, and their derivative along the tangents."""
        moved = None if _is_still(tangents[2]) else jax.tree.map(_dense, tangents[2])
        direction = (*map(_dense, tangents[:2]), moved)
        return slopes_by_all(*primals), curvature(primals, direction)

    slopes_by_all = _with_kernel(_slopes_by_all, along, "slopes by all", derived_slopes)

    def derived_values(primals: tuple, tangents: tuple) -> tuple:
        """Penalties and greatest excesses, and their derivative along the tangents."""
        is_solvers = _is_still(tangents[2])  # the solver moves columns and durations alone
        penalties, worst, *by = (slopes if is_solvers else slopes_by_all)(*primals)
        tangents = jax.tree.map(_dense, tangents[: len(by)] if is_solvers else tangents)
        moved = jax.tree.leaves(jax.tree.map(_contracted, (*by,), tangents))
        return (penalties, worst), (sum(moved[1:], moved[0]), jnp.zeros_like(worst))

    integral = jax.custom_jvp(lambda *args: values(*args))
    integral.defjvp(derived_values, symbolic_zeros=True)
    return integral


def _greatest_of_segments(
    along: Along, columns: Array, durations: Array, parameters: PyTree
) -> tuple[Array, ...]:
    """Greatest excess over every limit: E arrays (N,)."""

    def of_segment(columns: Array, duration: Array) -> tuple[Array, ...]:
        motion = sample_motion(along.maps, along.nodes, columns, duration, along.orders)
        # Held: the peaks read every sample three times.
        excess = jax.lax.optimization_barrier(along.excess(motion, parameters))
        return tuple(greatest_by_parabolas(each, along.times()) for each in excess)

    return jax.vmap(of_segment)(columns, durations)


def _values(
    along: Along, columns: Array, durations: Array, parameters: PyTree
) -> tuple[Array, Array]:
    """Penalties and greatest excesses, (N,) each."""
    segments = jax.vmap(functools.partial(_of_segment, along), in_axes=(0, 0, None))
    return segments(columns, durations, parameters)


def _slopes(
    along: Along, columns: Array, durations: Array, parameters: PyTree
) -> tuple[Array, ...]:
    """Values, and slopes of the penalties by columns (N, C, 3) and durations (N,)."""
    value = lambda c, h: _values(along, c, h, parameters)  # noqa: E731
    penalties, pull_back, worst = jax.vjp(value, columns, durations, has_aux=True)
    return penalties, worst, *pull_back(jnp.ones_like(penalties))


def _slopes_by_all(along: Along, columns: Array, durations: Array, parameters: PyTree) -> tuple:
    """`_slopes`, and those by the parameters, which every segment has for itself: N in front."""

    def of_segment(columns: Array, duration: Array, parameters: PyTree) -> tuple:
        value = functools.partial(_of_segment, along)
        penalty, pull_back, worst = jax.vjp(value, columns, duration, parameters, has_aux=True)
        return penalty, jax.lax.stop_gradient(worst), *pull_back(jnp.ones_like(penalty))

    segments = jax.vmap(of_segment, in_axes=(0, 0, None))
    return segments(columns, durations, parameters)


def _curvature(along: Along, primals: tuple, tangents: tuple) -> tuple:
    """Derivative of `_slopes_by_all` along tangents; None for those of still parameters."""
    moves = 2 if tangents[2] is None else 3
    slopes = lambda *moving: _slopes_by_all(along, *moving, *primals[moves:])  # noqa: E731
    return jax.jvp(slopes, primals[:moves], tangents[:moves])[1]


def _contracted(slope: Array, tangent: Array) -> Array:
    """What a tangent adds to each segment's penalty, (N,)."""
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
    """Penalty and greatest excess of one segment."""
    weights = jnp.asarray(along.weights(), columns.dtype)
    margins, factors = (
        jnp.asarray(np.array(each)[:, None], columns.dtype)
        for each in (along.margins, along.hinge_weights)
    )
    motion = sample_motion(along.maps, along.nodes, columns, duration, along.orders)
    each = along.excess(motion, parameters)
    hinges = factors * smoothed_hinge(jnp.stack(each) + margins, along.hinge_width)
    penalty = duration * jnp.sum(hinges * weights)
    if along.rate is not None:
        penalty = penalty + duration * jnp.sum(along.rate(motion, parameters) * weights)
    # Of each sample first: a CPU reduces what is stacked limit by limit.
    return penalty, jnp.max(functools.reduce(jnp.maximum, each))
