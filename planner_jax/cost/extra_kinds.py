"""Extra limits and costs of a user's case: keep-outs, planes, fences, zones of speed or dislike."""

from typing import ClassVar

from flax import struct

from planner_jax.core.arithmetic import Numbers
from planner_jax.core.rules import NOT_NEGATIVE, NOT_ZERO, POSITIVE, Field, Table, below


def _size(vector: Numbers) -> Numbers:
    """Return the length (...) of vectors (..., 3), smoothed so that its slope at zero is zero."""
    return ((vector**2).sum(-1) + 1e-12) ** 0.5


def _beside(vector: Numbers, pos: Numbers) -> Numbers:
    """Return a vector (3,) with leading axes of length 1, so that it broadcasts with `pos`."""
    return vector[(None,) * (pos.ndim - vector.ndim)]


@struct.dataclass
class KeepOut:
    """A sphere that the quadrotor must not enter.

    Attributes:
        centre: (3,) [m], centre of the sphere.
        radius: () [m], radius of the sphere, > 0.
    """

    rules: ClassVar[Table] = (Field("radius", None, POSITIVE),)
    positions: ClassVar[dict] = {"centre": ()}

    centre: Numbers
    radius: Numbers

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return the depth of the positions inside the sphere, divided by its radius."""
        return 1.0 - _size(pos - _beside(self.centre, pos)) / self.radius


@struct.dataclass
class _Box:
    """A box along the world's axes.

    Attributes:
        low: (3,) [m], least coordinates.
        high: (3,) [m], greatest coordinates.
    """

    rules: ClassVar[Table] = (Field("low", None, below("high")),)
    positions: ClassVar[dict] = {"low": (), "high": ()}

    low: Numbers
    high: Numbers


@struct.dataclass
class KeepOutBox(_Box):
    """A box along the world's axes, with finite sides, that the quadrotor must not enter."""

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return the depth below the nearest face of the box, divided by half its shortest side."""
        low, high = _beside(self.low, pos), _beside(self.high, pos)
        half = 0.5 * (high - low)
        return (half - abs(pos - low - half)).min(-1) / half.min(-1)


@struct.dataclass
class Plane:
    """A wall or ceiling: the quadrotor must stay on the side to which the normal points.

    Attributes:
        point: (3,) [m], any point of the plane.
        normal: (3,) normal of the plane, of any length.
    """

    rules: ClassVar[Table] = (Field("normal", None, NOT_ZERO),)
    positions: ClassVar[dict] = {"point": ()}

    point: Numbers
    normal: Numbers

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return the distance [m] of positions beyond the plane, negative on the allowed side."""
        point, normal = _beside(self.point, pos), _beside(self.normal, pos)
        return ((point - pos) * normal).sum(-1) / (normal**2).sum(-1) ** 0.5


@struct.dataclass
class Geofence(_Box):
    """A box, with finite sides, that the quadrotor must not leave."""

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

    Attributes:
        centre: (3,) [m], centre of the sphere.
        radius: () [m], radius of the sphere, > 0.
        speed: () [m/s], greatest speed inside the sphere, > 0.
    """

    rules: ClassVar[Table] = (Field("radius", None, POSITIVE), Field("speed", None, POSITIVE))
    positions: ClassVar[dict] = {"centre": ()}

    centre: Numbers
    radius: Numbers
    speed: Numbers

    def excess(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return the ratio of the speed to the limit at the position, minus 1."""
        u = (5.0 - 4.0 * _size(pos - _beside(self.centre, pos)) / self.radius).clip(0.0, 1.0)
        return u * u * (3.0 - 2.0 * u) * _size(vel) / self.speed - 1.0


@struct.dataclass
class Dislike:
    """A sphere with a cost inside it, which the quadrotor avoids if it can.

    Attributes:
        centre: (3,) [m], centre of the sphere.
        radius: () [m], radius of the sphere, > 0.
        weight: () [1/s], weight of the cost; the planners' other costs are of the order of 1e-5 to
            1.
    """

    rules: ClassVar[Table] = (Field("radius", None, POSITIVE), Field("weight", None, NOT_NEGATIVE))
    positions: ClassVar[dict] = {"centre": ()}

    centre: Numbers
    radius: Numbers
    weight: Numbers

    def cost(self, pos: Numbers, vel: Numbers, acc: Numbers) -> Numbers:
        """Return weight * (1 - r^2 / radius^2)^2 at a distance r < radius from centre, else 0."""
        inside = 1.0 - ((pos - _beside(self.centre, pos)) ** 2).sum(-1) / self.radius**2
        return self.weight * inside.clip(0.0, 1.0) ** 2
