"""How far samples of a trajectory exceed the quadrotor's limits.

Each returns the squared quantity over its squared limit, less one: positive where the limit
is exceeded, without a square root to differentiate. `relative` turns that into the ratio of
the quantity to its limit, less one. Vectors may come as tuples of their components, as a
kernel has them.
"""

import dataclasses
import enum
import functools
from collections.abc import Callable, Sequence
from typing import ClassVar, Protocol

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.arithmetic import Components, components, reciprocal
from planner_jax.cost.along import Along, greatest_along
from planner_jax.cost.extras import Extra, extra_excess, extra_rate, greatest_extras, num_limits
from planner_jax.robot.quadrotor import (
    QuadrotorLimits,
    RotorLimits,
    body_rate_squared,
    rotor_thrusts,
)
from planner_jax.trajectory.polynomial import Motion
from planner_jax.trajectory.proportional_minco import ProportionalMinco


def _size_squared(vector: Components) -> Array:
    """|v|^2 of (..., 3), written out: a CPU compiles a sum over an axis into its own loop."""
    x, y, z = components(vector)
    return x * x + y * y + z * z


def speed_excess(vel: Components, limits: QuadrotorLimits) -> Array:
    """|v|^2 / v_max^2 - 1 for velocities (..., 3) [m/s] [Yu2023bat, eq. 18a]."""
    return _size_squared(vel) * reciprocal(limits.speed) ** 2 - 1.0


def acceleration_excess(acc: Components, limits: QuadrotorLimits) -> Array:
    """|a|^2 / a_max^2 - 1 for accelerations (..., 3) [m/s^2] [Yu2023bat, eq. 18a].

    Without such a limit it is -1.
    """
    if limits.acceleration is None:
        return 0.0 * components(acc)[0] - 1.0
    return _size_squared(acc) * reciprocal(limits.acceleration) ** 2 - 1.0


def body_rate_excess(
    acc: Components, jerk: Components, gravity: Array, limits: QuadrotorLimits
) -> Array:
    """|omega|^2 / omega_max^2 - 1 by flatness [Yu2023bat, eq. 18a]."""
    rate_squared = body_rate_squared(acc, jerk, gravity)
    return rate_squared * reciprocal(limits.body_rate) ** 2 - 1.0


def ground_excess(height: Array, limits: QuadrotorLimits) -> Array:
    """z_min - z [m] for heights (...) [m] ([Yu2023catch, eq. 28], without its squares).

    The squares of the print change sign below ground.
    """
    return limits.min_height - height


def motion_excess(
    motion: Motion, gravity: Array, limits: QuadrotorLimits
) -> tuple[Array, Array, Array, Array]:
    """[Yu2023bat]'s limits, each (N,): speed, acceleration, body rate, ground (eq. 18a)."""
    return (
        speed_excess(motion.vel, limits),
        acceleration_excess(motion.acc, limits),
        body_rate_excess(motion.acc, motion.jerk, gravity, limits),
        ground_excess(motion.height, limits),
    )


def limits_along(
    motion: Motion, given: tuple[Array, QuadrotorLimits, tuple[Extra, ...]]
) -> tuple[PyTree, ...]:
    """Excess (N,) over the limits of flight and then over the extra ones, for `cost.along`.

    Args:
        motion: samples of a trajectory.
        given: gravity, limits and extras of a case.
    """
    gravity, limits, extras = given
    return (*flight_excess(motion, gravity, limits), *extra_excess(motion, extras))


def rotor_excess(motion: Motion, gravity: Array, rotors: RotorLimits) -> tuple[Array, ...]:
    """Excess (N,) of each rotor's thrust over the greatest, then below the least, eight in all.

    Relative to the greatest thrust of a rotor.
    """
    thrusts = rotor_thrusts(motion.acc, motion.jerk, motion.snap, gravity, rotors)
    unit = reciprocal(rotors.max_thrust)
    above = tuple(thrust * unit - 1.0 for thrust in thrusts)
    return (*above, *((rotors.min_thrust - thrust) * unit for thrust in thrusts))


def relative(squared_excess: Array) -> Array:
    """Ratio of a quantity to its limit, less one, from the same of the squares."""
    return jnp.sqrt(jnp.maximum(squared_excess + 1.0, 1e-12)) - 1.0


def thrust_excess(
    acc: Components, gravity: Array, least: Array, most: Array
) -> tuple[Array, Array]:
    """How far the squared thrust f^2 leaves its bounds: 1 - f^2/least^2, f^2/most^2 - 1.

    Args:
        acc: (..., 3) [m/s^2].
        gravity: () [m/s^2].
        least: () [m/s^2], per unit mass.
        most: () [m/s^2], per unit mass.
    """
    x, y, z = components(acc)
    squared = _size_squared((x, y, z + gravity))
    return 1.0 - squared * reciprocal(least) ** 2, squared * reciprocal(most) ** 2 - 1.0


def thrust_band_excess(acc: Components, gravity: Array, least: Array, most: Array) -> Array:
    """Return (f - middle)^2 - half^2 [m^2/s^4] for the thrust f, as the code of [Yu2023catch] does.

    Args:
        acc: (..., 3) [m/s^2].
        gravity: () [m/s^2].
        least: () [m/s^2], per unit mass.
        most: () [m/s^2], per unit mass.
    """
    x, y, z = components(acc)
    thrust = jnp.sqrt(jnp.maximum(_size_squared((x, y, z + gravity)), 1e-6))
    middle, half = 0.5 * (most + least), 0.5 * (most - least)
    return (thrust - middle) ** 2 - half**2


class QuadrotorCase(Protocol):
    """What the penalties of a flight take from a case, which is a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[PyTree]]]

    @property
    def head_state(self) -> Array:
        """Position to jerk (4, 3) of the quadrotor at time 0."""
        ...

    @property
    def gravity(self) -> Array:
        """Magnitude () [m/s^2]."""
        ...

    @property
    def limits(self) -> QuadrotorLimits:
        """Limits of the quadrotor."""
        ...

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """() for one case, (B,) for a batch."""
        ...

    @property
    def extras(self) -> tuple[Extra, ...]:
        """Limits and costs of the user's own."""
        ...


class Measure(enum.Enum):
    """What an excess is in the terms of the quantity q and its limit, and what it is of."""

    ABOVE = "q^2 / most^2 - 1"
    BELOW = "1 - q^2 / least^2"
    PLAIN = "q / limit - 1, or the difference in its unit"

    @property
    def factor(self) -> float:
        """By which a small relative excess shows in it."""
        return 1.0 if self is Measure.PLAIN else 2.0

    def relative(self, excess: Array) -> Array:
        """The relative excess of the quantity."""
        if self is Measure.ABOVE:
            return relative(excess)
        if self is Measure.BELOW:
            return 1.0 - jnp.sqrt(jnp.maximum(1.0 - excess, 0.0))
        return excess


def _rotor_excess(motion: Motion, gravity: Array, own: QuadrotorLimits) -> tuple[Array, ...]:
    """Return `rotor_excess` by limits that have rotors."""
    assert own.rotors is not None
    return rotor_excess(motion, gravity, own.rotors)


@dataclasses.dataclass(frozen=True)
class _Kind:
    """Limits that are there together, or not."""

    field: str  # of `QuadrotorLimits`, None where they are not there
    measures: tuple[Measure, ...]  # one for each excess
    excess: Callable[
        [Motion, Array, QuadrotorLimits], tuple[Array, ...]
    ]  # of motion, gravity and limits
    orders: tuple[int, ...]  # of the motion, that they look at


_KINDS = (
    _Kind(
        "speed",
        (Measure.ABOVE,),
        lambda motion, gravity, own: (speed_excess(motion.vel, own),),
        (1,),
    ),
    _Kind(
        "acceleration",
        (Measure.ABOVE,),
        lambda motion, gravity, own: (acceleration_excess(motion.acc, own),),
        (2,),
    ),
    _Kind(
        "body_rate",
        (Measure.ABOVE,),
        lambda motion, gravity, own: (body_rate_excess(motion.acc, motion.jerk, gravity, own),),
        (2, 3),
    ),
    _Kind(
        "max_thrust",
        (Measure.BELOW, Measure.ABOVE),
        lambda motion, gravity, own: thrust_excess(motion.acc, gravity, *own.thrust_bounds),
        (2,),
    ),
    _Kind(
        "min_height",
        (Measure.PLAIN,),
        lambda motion, gravity, own: (ground_excess(motion.height, own),),
        (0,),
    ),
    _Kind(
        "rotors",
        (Measure.PLAIN,) * 8,
        _rotor_excess,
        (2, 3, 4),
    ),
)


def _kinds(limits: QuadrotorLimits) -> list[_Kind]:
    """Those that there are."""
    return [kind for kind in _KINDS if vars(limits)[kind.field] is not None]


def flight_excess(motion: Motion, gravity: Array, limits: QuadrotorLimits) -> tuple[Array, ...]:
    """Excess (N,) over each of the limits that there are, in the order of `flight_measures`."""
    return tuple(
        excess for kind in _kinds(limits) for excess in kind.excess(motion, gravity, limits)
    )


def flight_measures(limits: QuadrotorLimits) -> tuple[Measure, ...]:
    """What the excesses of `flight_excess` are."""
    return tuple(measure for kind in _kinds(limits) for measure in kind.measures)


def flight_names(limits: QuadrotorLimits) -> tuple[str, ...]:
    """Return the fields of the limits that the excesses of `flight_excess` belong to."""
    return tuple(kind.field for kind in _kinds(limits) for _ in kind.measures)


def relative_excess(limits: QuadrotorLimits, excess: Sequence[Array]) -> list[Array]:
    """Relative excesses, of those of `flight_excess`."""
    measures = flight_measures(limits)
    return [of.relative(each) for of, each in zip(measures, excess, strict=True)]


def flight_along(
    maps: ProportionalMinco, nodes: int, case: QuadrotorCase, margin: float, hinge_width: float
) -> Along:
    """Penalties of all limits of a flight along its way; squares carry twice the relative margin.

    Args:
        maps: of the trajectory.
        nodes: intervals a piece.
        case: with `limits` and `extras`, whose arrays are not looked at.
        margin: relative, at which penalties begin inside a limit.
        hinge_width: of the smoothed hinges.
    """
    factors = [measure.factor for measure in flight_measures(case.limits)]
    factors += [1.0] * num_limits(case.extras)
    margins = tuple(margin * factor for factor in factors)
    rate = extra_rate if case.extras else None
    orders = 4 if case.limits.rotors is None else 5
    groups = () if case.extras else _groups(case.limits)
    return Along(maps, nodes, limits_along, margins, hinge_width, rate, orders, groups)


def _groups(limits: QuadrotorLimits) -> tuple[tuple[tuple[int, int], ...], ...]:
    """Places (order, axis) of the motion that limits look at together; of positions, the height."""
    together: list[set[int]] = []
    for kind in _kinds(limits):
        joined = set(kind.orders).union(*(each for each in together if each & set(kind.orders)))
        together = [each for each in together if not each & joined] + [joined]
    axes = lambda order: (2,) if order == 0 else (0, 1, 2)  # noqa: E731
    return tuple(
        tuple((order, axis) for order in sorted(each) for axis in axes(order)) for each in together
    )


def greatest_excess(
    maps: ProportionalMinco, nodes: int, columns: Array, durations: Array, case: QuadrotorCase
) -> list[Array]:
    """By how much a finished plan of N segments exceeds each limit, relative, (N,) each.

    Peaks between the samples count: those of flight by parabolas, those of extras by tangents.

    Args:
        maps: of a segment.
        nodes: intervals a piece at which the limits of flight are looked at.
        columns: (N, C, 3) boundary rows and whitened offsets of each segment.
        durations: (N,) [s], mean of its pieces.
        case: with `gravity`, `limits` and `extras`.
    """
    bare = dataclasses.replace(case, extras=())
    along = flight_along(maps, nodes, bare, 0.0, 1.0)
    greatest = greatest_along(along, columns, durations, (case.gravity, case.limits, ()))
    extras = jax.vmap(functools.partial(greatest_extras, maps), in_axes=(0, 0, None))
    flown = relative_excess(case.limits, greatest)
    return [*flown, *extras(columns, durations, case.extras)]
