"""Limits and costs that a user defines along a quadrotor's trajectory: `extras` of a case.

An extra is a `flax.struct.dataclass` of arrays with a method `excess`, `cost` or both, which are
pure and for one case. The planner calls them with jax arrays. The referee, an independent check of
finished plans, calls `excess` with float64 NumPy arrays: use only operators and methods that both
have. Other values of the arrays need no new compilation, but another class does. The search
evaluates samples some centimetres apart, and then checks the plan every few millimetres. Smaller
obstacles may be missed.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import PyTree

from planner_jax.core.arithmetic import Numbers, numpy_of, to_host
from planner_jax.core.checks import format_shapes, numeric
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.cost.penalty import greatest_by_tangents
from planner_jax.trajectory.polynomial import Motion
from planner_jax.trajectory.proportional_minco import ProportionalMinco, by_pieces

# Number of samples per polynomial piece when a finished plan is checked: obstacles may be small.
_CLOSE_NODES = 64


@runtime_checkable
class ExtraLimit(Protocol):
    """A limit that a user defines. Planners keep it, and the check of finished plans tests it."""

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return the excess (...), > 0 if broken, of a motion (..., 3) in SI units."""
        ...


@runtime_checkable
class ExtraCost(Protocol):
    """A term of the planner's cost that a user defines; the check of finished plans ignores it."""

    def cost(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return the cost per second (...), >= 0, of a motion (..., 3) in SI units."""
        ...


Extra = ExtraLimit | ExtraCost


def for_batch(extras: object, batch: tuple[int, ...], dtype: DTypeLike) -> tuple[Extra, ...]:
    """Broadcast extras (the user's limits and costs) of one case to a batch, and convert them.

    `batch` is () or (B,), and `dtype` the type of all leaves of the result. Extras that have the
    batch axis already are only converted.
    """
    if not isinstance(extras, Sequence) or isinstance(extras, str):
        raise ArgumentTypeError("extras", "a sequence of limits and costs", extras)
    for extra in extras:
        if isinstance(extra, type) or not isinstance(extra, ExtraLimit | ExtraCost):
            raise ArgumentTypeError("extras", "a method excess or cost", extra, verb="have")

    def read(value: object) -> Numbers:
        array = numeric(value)
        return to_host(value if array is None else array)

    def repeat(array: Numbers, lead: tuple[int, ...]) -> Numbers:
        return numpy_of(array).broadcast_to(array, lead + array.shape)

    def spread(place: int, extra: Extra) -> Extra:
        extra = jax.tree.map(read, extra, is_leaf=lambda x: isinstance(x, tuple | list))
        shapes = [leaf.shape for leaf in jax.tree.leaves(extra)]
        sample = np.ones((2 + max((0, *batch, *sum(shapes, ()))), 3))  # longer than any leaf
        methods = [extra.excess] if isinstance(extra, ExtraLimit) else []
        methods += [extra.cost] if isinstance(extra, ExtraCost) else []
        try:
            alike = {np.shape(m(sample, sample, sample)) for m in methods} == {sample.shape[:1]}
        except (ValueError, TypeError):
            alike = False
        if not alike and (not batch or any(shape[: len(batch)] != batch for shape in shapes)):
            rule = f"for one case, or have the axes {batch} in front" if batch else "for one case"
            found = f"a {type(extra).__name__} with {format_shapes(extra)}"
            raise ArgumentError(f"extras.{place}", rule, shown=found)
        lead = batch if alike else ()
        return jax.tree.map(lambda x: jnp.asarray(repeat(x, lead), dtype), extra)

    return tuple(spread(place, extra) for place, extra in enumerate(extras))


def num_limits(extras: tuple[Extra, ...]) -> int:
    """Return how many of the extras (terms that a user adds) are limits."""
    return sum(isinstance(extra, ExtraLimit) for extra in extras)


def extra_excess(motion: Motion, extras: tuple[Extra, ...]) -> tuple[Numbers, ...]:
    """Return the excess (N,) over each limit that the user added, at N samples of a motion."""
    samples = motion.pos, motion.vel, motion.acc
    return tuple(extra.excess(*samples) for extra in extras if isinstance(extra, ExtraLimit))


def greatest_extras(
    maps: ProportionalMinco, columns: Array, duration: Array, extras: tuple[Extra, ...]
) -> tuple[Array, ...]:
    """Return the greatest excess () over each limit that the user added, along one segment.

    `columns` (C, 3), end states and waypoint offsets, and the mean piece duration `duration` () [s]
    determine the segment, which the matrices `maps` sample. The result is never too small if the
    excess is concave between samples: tangents at neighbouring samples intersect above the excess.
    """
    if not num_limits(extras):
        return ()

    def at(pos: Array, vel: Array, acc: Array) -> tuple[Numbers, ...]:
        return tuple(e.excess(pos, vel, acc) for e in extras if isinstance(e, ExtraLimit))

    def of_piece(motion: Motion, lasting: Array) -> tuple[Array, ...]:
        state, change = (motion.pos, motion.vel, motion.acc), (motion.vel, motion.acc, motion.jerk)
        values, slopes = jax.jvp(at, state, change)
        step = lasting / _CLOSE_NODES
        return tuple(
            greatest_by_tangents(value, slope, step)
            for value, slope in zip(values, slopes, strict=True)
        )

    greatest = by_pieces(of_piece, maps, _CLOSE_NODES, columns, duration)
    return tuple(jnp.max(each) for each in greatest)


def extra_rate(motion: Motion, given: tuple) -> PyTree:
    """Return the cost per second (N,) of all extras (user's terms), the last entry of `given`."""
    samples = motion.pos, motion.vel, motion.acc
    rates = (extra.cost(*samples) for extra in given[-1] if isinstance(extra, ExtraCost))
    return sum(rates, jnp.zeros_like(motion.height))
