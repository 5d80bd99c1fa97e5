"""Limits and cost terms of a user's own along a quadrotor's way: a part of the case.

An extra is a `flax.struct.dataclass` of arrays with a method `excess`, `cost` or both, pure and for
one case. They are called on jax arrays, and `excess` on float64 NumPy arrays by the referee: use
operators and the methods of both. Another value compiles nothing anew; another class does. The
search looks at samples some centimetres apart, and a finished plan is looked at every few
millimetres, peaks in between by tangents; what is smaller than that may be missed.
"""

from collections.abc import Sequence
from typing import ClassVar, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import PyTree

from planner_jax.core.arithmetic import Numbers
from planner_jax.core.checks import format_shapes
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.rules import NOT_NEGATIVE, NOT_ZERO, POSITIVE, Field, Table, below
from planner_jax.cost.penalty import greatest_by_tangents
from planner_jax.trajectory.polynomial import Motion
from planner_jax.trajectory.proportional_minco import ProportionalMinco, by_pieces

# Intervals a piece at which a finished plan is held against extra limits: a way past an edge, or
# past a small sphere, peaks between two samples of the search.
_CLOSE_NODES = 64


@runtime_checkable
class ExtraLimit(Protocol):
    """A limit; the planner keeps it, the referee judges it."""

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Excess (...) relative to the limit, > 0 where it is broken; arguments (..., 3), SI."""
        ...


@runtime_checkable
class ExtraCost(Protocol):
    """A term of the planner's cost; the referee does not look at it."""

    def cost(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Cost a second (...), >= 0, integrated along the trajectory; arguments (..., 3), SI."""
        ...


Extra = ExtraLimit | ExtraCost


def _size(vector: Numbers) -> Numbers:
    """Length (...) of vectors (..., 3); its slope at zero is zero."""
    return ((vector**2).sum(-1) + 1e-12) ** 0.5


@struct.dataclass
class KeepOut:
    """A sphere that may not be entered."""

    rules: ClassVar[Table] = (Field("radius", None, POSITIVE),)

    centre: Numbers  # (3,) [m]
    radius: Numbers  # () [m], > 0

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Depth over radius."""
        return 1.0 - _size(pos - self.centre) / self.radius


@struct.dataclass
class KeepOutBox:
    """A box along the world's axes that may not be entered, its sides finite."""

    rules: ClassVar[Table] = (Field("low", None, below("high")),)

    low: Numbers  # (3,) [m]
    high: Numbers  # (3,) [m]

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Depth under the nearest face, over half of the shortest side."""
        half = 0.5 * (self.high - self.low)
        return (half - abs(pos - self.low - half)).min(-1) / half.min(-1)


@struct.dataclass
class Plane:
    """A plane of which only the side that its normal points to may be used: a wall, a ceiling."""

    rules: ClassVar[Table] = (Field("normal", None, NOT_ZERO),)

    point: Numbers  # (3,) [m], anywhere on the plane
    normal: Numbers  # (3,), of any length

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Metres beyond the plane."""
        return ((self.point - pos) * self.normal).sum(-1) / (self.normal**2).sum(-1) ** 0.5


@struct.dataclass
class Geofence:
    """A box that may not be left, its sides finite."""

    rules: ClassVar[Table] = (Field("low", None, below("high")),)

    low: Numbers  # (3,) [m]
    high: Numbers  # (3,) [m]

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Metres outside, of the worst axis."""
        half = 0.5 * (self.high - self.low)
        return (abs(pos - self.low - half) - half).max(-1)


@struct.dataclass
class SpeedZone:
    """A speed limit within a sphere, which fades up to 1.25 radii.

    There it is speed / (u^2 (3 - 2 u)), u falling from one to zero: continuous with its slope.
    """

    rules: ClassVar[Table] = (
        Field("radius", None, POSITIVE),
        Field("speed", None, POSITIVE),
    )

    centre: Numbers  # (3,) [m]
    radius: Numbers  # () [m], > 0
    speed: Numbers  # () [m/s], > 0

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Speed over the limit, less one."""
        u = (5.0 - 4.0 * _size(pos - self.centre) / self.radius).clip(0.0, 1.0)
        return u * u * (3.0 - 2.0 * u) * _size(vel) / self.speed - 1.0


@struct.dataclass
class Dislike:
    """A sphere that is better avoided."""

    rules: ClassVar[Table] = (
        Field("radius", None, POSITIVE),
        Field("weight", None, NOT_NEGATIVE),
    )

    centre: Numbers  # (3,) [m]
    radius: Numbers  # () [m], > 0
    weight: Numbers  # () [1/s]; the planners' other costs are of the order of 1e-5 to 1

    def cost(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Weight * (1 - distance^2 / radius^2)^2 inside, nothing outside."""
        inside = 1.0 - ((pos - self.centre) ** 2).sum(-1) / self.radius**2
        return self.weight * inside.clip(0.0, 1.0) ** 2


def for_batch(extras: object, batch: tuple[int, ...], dtype: DTypeLike) -> tuple[Extra, ...]:
    """Extras whose leaves have a dtype and the axes of a batch, () or (B,), in front.

    Raises:
        TypeError: they are no sequence, or one of them is no extra.
        ValueError: an extra is not for one case, and not all of its leaves have these axes.
    """
    if not isinstance(extras, Sequence) or isinstance(extras, str):
        raise ArgumentTypeError("extras", "a sequence of limits and costs", extras)
    for extra in extras:
        if isinstance(extra, type) or not isinstance(extra, ExtraLimit | ExtraCost):
            raise ArgumentTypeError("extras", "a method excess or cost", extra, verb="have")

    def spread(place: int, extra: Extra) -> Extra:
        extra = jax.tree.map(np.asarray, extra, is_leaf=lambda x: isinstance(x, tuple | list))
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
        return jax.tree.map(lambda x: jnp.asarray(np.broadcast_to(x, lead + x.shape), dtype), extra)

    return tuple(spread(place, extra) for place, extra in enumerate(extras))


def num_limits(extras: tuple[Extra, ...]) -> int:
    """How many of them are limits."""
    return sum(isinstance(extra, ExtraLimit) for extra in extras)


def extra_excess(motion: Motion, extras: tuple[Extra, ...]) -> tuple[Numbers, ...]:
    """The excess (N,) over each that is a limit, along samples of a motion."""
    samples = motion.pos, motion.vel, motion.acc
    return tuple(extra.excess(*samples) for extra in extras if isinstance(extra, ExtraLimit))


def greatest_extras(
    maps: ProportionalMinco, columns: Array, duration: Array, extras: tuple[Extra, ...]
) -> tuple[Array, ...]:
    """Greatest excess over each that is a limit along a whole segment, () each.

    Where it is concave between samples it is not missed: see `penalty.greatest_by_tangents`.

    Args:
        maps: constant maps of M pieces.
        columns: (2s + M - 1, 3) boundary rows and whitened offsets.
        duration: () [s], mean of the pieces.
        extras: of a case.
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
    """The cost a second (N,) of all extras, which are the last of what is given."""
    samples = motion.pos, motion.vel, motion.acc
    rates = (extra.cost(*samples) for extra in given[-1] if isinstance(extra, ExtraCost))
    return sum(rates, jnp.zeros_like(motion.height))
