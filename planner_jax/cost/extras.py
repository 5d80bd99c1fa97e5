"""Limits and costs that a user defines along a quadrotor's trajectory: `extras` of a case.

An extra is a `flax.struct.dataclass` of arrays with a method `excess`, `cost` or both, which are
pure and for one case. The planner calls them with jax arrays. The referee, an independent check of
finished plans, calls `excess` with float64 NumPy arrays: use only operators and methods that both
have. Other values of the arrays need no new compilation, but another class does. The search
evaluates samples some centimetres apart, and then checks the plan every few millimetres. Smaller
obstacles may be missed.
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


def _size(vector: Numbers) -> Numbers:
    """Return the length (...) of vectors (..., 3), smoothed so that its slope at zero is zero."""
    return ((vector**2).sum(-1) + 1e-12) ** 0.5


def _beside(vector: Numbers, pos: Numbers) -> Numbers:
    """Return a vector (3,) with leading axes of length 1, so that it broadcasts with `pos`."""
    return vector[(None,) * (pos.ndim - vector.ndim)]


@struct.dataclass
class KeepOut:
    """A sphere that the quadrotor must not enter."""

    rules: ClassVar[Table] = (Field("radius", None, POSITIVE),)
    positions: ClassVar[dict] = {"centre": ()}

    centre: Numbers  # (3,) [m]
    radius: Numbers  # () [m], > 0

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return the depth of the positions inside the sphere, divided by its radius."""
        return 1.0 - _size(pos - _beside(self.centre, pos)) / self.radius


@struct.dataclass
class KeepOutBox:
    """A box along the world's axes, with finite sides, that the quadrotor must not enter."""

    rules: ClassVar[Table] = (Field("low", None, below("high")),)
    positions: ClassVar[dict] = {"low": (), "high": ()}

    low: Numbers  # (3,) [m]
    high: Numbers  # (3,) [m]

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return the depth below the nearest face of the box, divided by half its shortest side."""
        low, high = _beside(self.low, pos), _beside(self.high, pos)
        half = 0.5 * (high - low)
        return (half - abs(pos - low - half)).min(-1) / half.min(-1)


@struct.dataclass
class Plane:
    """A wall or ceiling: the quadrotor must stay on the side to which the normal points."""

    rules: ClassVar[Table] = (Field("normal", None, NOT_ZERO),)
    positions: ClassVar[dict] = {"point": ()}

    point: Numbers  # (3,) [m], anywhere on the plane
    normal: Numbers  # (3,), of any length

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return the distance [m] of positions beyond the plane, negative on the allowed side."""
        point, normal = _beside(self.point, pos), _beside(self.normal, pos)
        return ((point - pos) * normal).sum(-1) / (normal**2).sum(-1) ** 0.5


@struct.dataclass
class Geofence:
    """A box, with finite sides, that the quadrotor must not leave."""

    rules: ClassVar[Table] = (Field("low", None, below("high")),)
    positions: ClassVar[dict] = {"low": (), "high": ()}

    low: Numbers  # (3,) [m]
    high: Numbers  # (3,) [m]

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return the distance [m] outside of the box, along the axis where it is greatest."""
        low, high = _beside(self.low, pos), _beside(self.high, pos)
        half = 0.5 * (high - low)
        return (abs(pos - low - half) - half).max(-1)


@struct.dataclass
class SpeedZone:
    """A speed limit within a sphere, which fades out between the sphere and 1.25 radii.

    The limit is speed / (u^2 (3 - 2 u)), where u falls linearly from one at the sphere to zero at
    1.25 radii. This limit and its slope are continuous.
    """

    rules: ClassVar[Table] = (Field("radius", None, POSITIVE), Field("speed", None, POSITIVE))
    positions: ClassVar[dict] = {"centre": ()}

    centre: Numbers  # (3,) [m]
    radius: Numbers  # () [m], > 0
    speed: Numbers  # () [m/s], > 0

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return the ratio of the speed to the limit at the position, minus 1."""
        u = (5.0 - 4.0 * _size(pos - _beside(self.centre, pos)) / self.radius).clip(0.0, 1.0)
        return u * u * (3.0 - 2.0 * u) * _size(vel) / self.speed - 1.0


@struct.dataclass
class Dislike:
    """A sphere with a cost inside it, which the quadrotor avoids if it can."""

    rules: ClassVar[Table] = (Field("radius", None, POSITIVE), Field("weight", None, NOT_NEGATIVE))
    positions: ClassVar[dict] = {"centre": ()}

    centre: Numbers  # (3,) [m]
    radius: Numbers  # () [m], > 0
    weight: Numbers  # () [1/s]; the planners' other costs are of the order of 1e-5 to 1

    def cost(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return weight * (1 - r^2 / radius^2)^2 at a distance r < radius from centre, else 0."""
        inside = 1.0 - ((pos - _beside(self.centre, pos)) ** 2).sum(-1) / self.radius**2
        return self.weight * inside.clip(0.0, 1.0) ** 2


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
