"""Functions that compute how far samples of a trajectory exceed the quadrotor's limits.

Most functions return the excess q^2 / limit^2 - 1 of a quantity q. The excess is positive where the
limit is exceeded, and needs no square root. `relative` converts it to q / limit - 1. Vectors may be
tuples of their components, as they are in a CUDA kernel.
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

from planner_jax.core.arithmetic import Components, at_least, components, inverse_sqrt, reciprocal
from planner_jax.cost.along import Along, greatest_along
from planner_jax.cost.extras import Extra, extra_excess, extra_rate, greatest_extras, num_limits
from planner_jax.robot.quadrotor import (
    QuadrotorLimits,
    add_drag,
    add_drag_rate,
    body_rate_squared,
    net_thrust,
    thrust_in_air,
)
from planner_jax.trajectory.polynomial import Motion, PiecewisePolynomial, sample_orders
from planner_jax.trajectory.proportional_minco import ProportionalMinco


def _size_squared(vector: Components) -> Array:
    """Return |v|^2 of vectors (..., 3); for a sum over an axis XLA would compile one more loop."""
    x, y, z = components(vector)
    return x * x + y * y + z * z


def speed_excess(vel: Components, most: Array) -> Array:
    """Return |v|^2 / v_max^2 - 1 for velocities (..., 3) [m/s] [Yu2023bat, eq. 18a]."""
    return _size_squared(vel) * reciprocal(most) ** 2 - 1.0


def acceleration_excess(acc: Components, most: Array) -> Array:
    """Return |a|^2 / a_max^2 - 1 for accelerations (..., 3) [m/s^2] [Yu2023bat, eq. 18a]."""
    return _size_squared(acc) * reciprocal(most) ** 2 - 1.0


def body_rate_excess(acc: Components, jerk: Components, gravity: Array, most: Array) -> Array:
    """Return |omega|^2 / omega_max^2 - 1 for the body rates omega [rad/s] [Yu2023bat, eq. 18a]."""
    return body_rate_squared(acc, jerk, gravity) * reciprocal(most) ** 2 - 1.0


def ground_excess(height: Array, least: Array) -> Array:
    """Return z_min - z [m] for heights z [m] [Yu2023catch, eq. 28, without its square]."""
    return least - height


def limits_along(
    motion: Motion, given: tuple[Array, QuadrotorLimits, tuple[Extra, ...]]
) -> tuple[PyTree, ...]:
    """Return the excess (N,) at N samples over each limit of flight, then over user's limits.

    `given` is gravity [m/s^2], limits of flight, and extras (the user's limits and costs).
    """
    gravity, limits, extras = given
    return (*flight_excess(motion, gravity, limits), *extra_excess(motion, extras))


def relative(squared_excess: Array) -> Array:
    """Return q / limit - 1 for a quantity q, given q^2 / limit^2 - 1."""
    return jnp.sqrt(jnp.maximum(squared_excess + 1.0, 1e-12)) - 1.0


def thrust_excess(
    acc: Components, gravity: Array, least: Array, most: Array
) -> tuple[Array, Array]:
    """Return 1 - f^2 / least^2 and f^2 / most^2 - 1 for the thrust f per mass [m/s^2]."""
    x, y, z = components(acc)
    squared = _size_squared((x, y, z + gravity))
    return 1.0 - squared * reciprocal(least) ** 2, squared * reciprocal(most) ** 2 - 1.0


def tilt_excess(acc: Components, gravity: Array, most: Array) -> Array:
    """Return sin^2(theta / 2) / sin^2(theta_max / 2) - 1 for the tilt theta of the thrust.

    The cosine of the tilt is  z_z = tau_z / |tau| , and  2 sin^2(theta / 2) = 1 - z_z .
    """
    x, y, z = components(acc)
    up = z + gravity
    cosine = up * inverse_sqrt(at_least(_size_squared((x, y, up)), 1e-4))
    return (1.0 - cosine) * reciprocal(1.0 - jnp.cos(most)) - 1.0


_OVERTURN_NODES = 4  # intervals of a piece, at whose ends `overturn_excess` evaluates the motion
_WEAK_STEPS = 3  # number of steps that minimise the thrust within an interval


class QuadrotorCase(Protocol):
    """The fields that a case, a dataclass, must have for the penalties of a flight."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[PyTree]]]

    @property
    def head_state(self) -> Array:
        """Position, velocity, acceleration and jerk (4, 3) of the quadrotor at time 0."""
        ...

    @property
    def gravity(self) -> Array:
        """Magnitude () [m/s^2] of the gravitational acceleration."""
        ...

    @property
    def limits(self) -> QuadrotorLimits:
        """Limits of the quadrotor's motion, such as the greatest speed."""
        ...

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape () for one case, or (B,) for a batch of B cases."""
        ...

    @property
    def extras(self) -> tuple[Extra, ...]:
        """Limits and costs that the user defines."""
        ...


class Measure(enum.Enum):
    """Formula of an excess: how far a limited quantity q, such as speed, exceeds its limit."""

    ABOVE = "q^2 / most^2 - 1"
    BELOW = "1 - q^2 / least^2"
    PLAIN = "q / limit - 1, or the difference in its unit"

    @property
    def factor(self) -> float:
        """Slope of this formula by q / limit at q = limit: 2 for formulas with squares, else 1."""
        return 1.0 if self is Measure.PLAIN else 2.0

    def relative(self, excess: Array) -> Array:
        """Convert an excess by this formula to the relative excess, such as q / limit - 1."""
        if self is Measure.ABOVE:
            return relative(excess)
        if self is Measure.BELOW:
            return 1.0 - jnp.sqrt(jnp.maximum(1.0 - excess, 0.0))
        return excess


def _rotor_excess(motion: Motion, gravity: Array, limits: QuadrotorLimits) -> tuple[Array, ...]:
    """Return f / f_max - 1 for each rotor's thrust f (N,), then (f_min - f) / f_max for each."""
    from planner_jax.robot.rotor_thrusts import rotor_thrusts  # few robots have these limits

    rotors = limits.rotors
    assert rotors is not None
    air, load = limits.air, _load(motion, limits)
    pull = None if air is None else thrust_in_air(air, motion.vel, load.acc, gravity)
    thrusts = rotor_thrusts(load.acc, load.jerk, load.snap, gravity, rotors, pull)
    unit = reciprocal(rotors.max_thrust)
    above = tuple(thrust * unit - 1.0 for thrust in thrusts)
    return (*above, *((rotors.min_thrust - thrust) * unit for thrust in thrusts))


def _load(motion: Motion, limits: QuadrotorLimits) -> Motion:
    """Return the motion that needs the same attitude without drag and wind."""
    if limits.air is None:
        return motion
    snap = motion.snap
    return dataclasses.replace(
        motion,
        acc=add_drag(limits.air, motion.vel, motion.acc),
        jerk=add_drag_rate(limits.air, motion.acc, motion.jerk),
        snap=None if snap is None else add_drag_rate(limits.air, motion.jerk, snap),
    )


def _rate_excess(motion: Motion, gravity: Array, limits: QuadrotorLimits) -> tuple[Array]:
    load = _load(motion, limits)
    return (body_rate_excess(load.acc, load.jerk, gravity, limits.body_rate),)


def _thrust_excess(motion: Motion, gravity: Array, limits: QuadrotorLimits) -> tuple[Array, Array]:
    least, most = limits.thrust_bounds
    if limits.air is None:
        return thrust_excess(motion.acc, gravity, least, most)
    load = _load(motion, limits)
    squared = thrust_in_air(limits.air, motion.vel, load.acc, gravity) ** 2
    return 1.0 - squared * reciprocal(least) ** 2, squared * reciprocal(most) ** 2 - 1.0


@dataclasses.dataclass(frozen=True)
class _Kind:
    field: str  # field of `QuadrotorLimits` that is None for a quadrotor without these limits
    measures: tuple[Measure, ...]  # one for each excess
    excess: Callable[[Motion, Array, PyTree], tuple[Array, ...]]  # of motion, gravity and limits
    orders: tuple[int, ...]  # orders of the motion's derivatives on which the excess depends


_ABOVE, _BELOW, _PLAIN = Measure
_KINDS = (
    _Kind("speed", (_ABOVE,), lambda motion, _, own: (speed_excess(motion.vel, own.speed),), (1,)),
    _Kind(
        "acceleration",
        (_ABOVE,),
        lambda motion, _, own: (acceleration_excess(motion.acc, own.acceleration),),
        (2,),
    ),
    _Kind("body_rate", (_ABOVE,), _rate_excess, (2, 3)),
    _Kind("max_thrust", (_BELOW, _ABOVE), _thrust_excess, (2,)),
    _Kind(
        "min_height",
        (_PLAIN,),
        lambda motion, _, own: (ground_excess(motion.height, own.min_height),),
        (0,),
    ),
    _Kind(
        "max_tilt",
        (_ABOVE,),
        lambda motion, gravity, own: (tilt_excess(_load(motion, own).acc, gravity, own.max_tilt),),
        (2,),
    ),
    _Kind("rotors", (_PLAIN,) * 2, _rotor_excess, (2, 3, 4)),  # of one rotor; the last
)


def _kinds(limits: QuadrotorLimits) -> list[_Kind]:
    kinds = [kind for kind in _KINDS if vars(limits)[kind.field] is not None]
    if limits.air is not None:  # the drag depends on the velocity too
        of_thrust = ("body_rate", "max_thrust", "max_tilt", "rotors")
        kinds = [
            dataclasses.replace(kind, orders=(1, *kind.orders)) if kind.field in of_thrust else kind
            for kind in kinds
        ]
    if limits.rotors is not None:
        measures = limits.rotors.mixer.shape[-2] * kinds[-1].measures
        kinds[-1] = dataclasses.replace(kinds[-1], measures=measures)
    return kinds


def flight_excess(motion: Motion, gravity: Array, limits: QuadrotorLimits) -> tuple[Array, ...]:
    """Return the excess (N,) at N samples over each limit that is not None, in a fixed order."""
    return tuple(
        excess for kind in _kinds(limits) for excess in kind.excess(motion, gravity, limits)
    )


def flight_measures(limits: QuadrotorLimits) -> tuple[Measure, ...]:
    """Return the `Measure`, that is, the formula, of each excess that `flight_excess` returns."""
    return tuple(measure for kind in _kinds(limits) for measure in kind.measures)


def flight_names(limits: QuadrotorLimits) -> tuple[str, ...]:
    """Return the name of the field of `QuadrotorLimits` for each entry of `flight_excess`."""
    return tuple(kind.field for kind in _kinds(limits) for _ in kind.measures)


def relative_excess(limits: QuadrotorLimits, excess: Sequence[Array]) -> list[Array]:
    """Convert the excesses of `flight_excess`, mostly q^2 / limit^2 - 1, to q / limit - 1."""
    measures = flight_measures(limits)
    return [of.relative(each) for of, each in zip(measures, excess, strict=True)]


def flight_along(
    maps: ProportionalMinco,
    nodes: int,
    case: QuadrotorCase,
    margin: float,
    hinge_width: float | None,
) -> Along:
    """Return the penalties for exceeding the limits of a case along the segments of a flight.

    Each penalty starts at a relative distance `margin` before its limit, and is smoothed over
    `hinge_width`. The matrices `maps` sample it at `nodes` intervals of each polynomial piece. If
    `hinge_width` is None, the parameters of the integral have a factor on the margin, and the
    width.
    """
    factors = [measure.factor for measure in flight_measures(case.limits)]
    factors += [1.0] * num_limits(case.extras)
    margins = tuple(margin * factor for factor in factors)
    rate = extra_rate if case.extras else None
    orders = 4 if case.limits.rotors is None else 5
    groups = () if case.extras else _groups(case.limits)
    return Along(maps, nodes, limits_along, margins, hinge_width, rate, orders, groups)


def _groups(limits: QuadrotorLimits) -> tuple[tuple[tuple[int, int], ...], ...]:
    together: list[set[int]] = []
    for kind in _kinds(limits):
        joined = set(kind.orders).union(*(each for each in together if each & set(kind.orders)))
        together = [each for each in together if not each & joined] + [joined]
    axes = lambda order: (2,) if order == 0 else (0, 1, 2)  # noqa: E731
    return tuple(
        tuple((order, axis) for order in sorted(each) for axis in axes(order)) for each in together
    )


def overturn_excess(
    trajectory: PiecewisePolynomial, gravity: Array, limits: QuadrotorLimits
) -> Array:
    """Return the greatest relative excess of the body rate between samples, where it peaks; ().

    It peaks upside down and where the thrust is nearly zero (`_rate_of_weak_thrust`). Upside down
    the Hopf fibration has no attitude: the body turns about the thrust at a rate that grows without
    limit, for a time shorter than the intervals between samples. From each sample the thrust
    direction z is followed at its rate w along a great circle. With the vertical component n of the
    circle's normal, the body rate at the lowest point is  w sqrt(1 + (n / (1 + z_z))^2) , and there
    1 + z_z = 1 - sqrt(1 - n^2) . Only lowest points within an interval count.
    """
    if limits.air is None:
        acc, jerk = sample_orders(trajectory, _OVERTURN_NODES, (2, 3))
    else:
        vel, acc, jerk = sample_orders(trajectory, _OVERTURN_NODES, (1, 2, 3))
        acc, jerk = add_drag(limits.air, vel, acc), add_drag_rate(limits.air, acc, jerk)
    pull = net_thrust(acc, gravity)
    step = trajectory.durations[:, None] / _OVERTURN_NODES
    size, mixed = at_least(_dot(pull, pull), 1e-4), _dot(pull, jerk)
    rate = jnp.maximum((size * _dot(jerk, jerk) - mixed * mixed) / size**2, 1e-6)
    (x, y, z), (a, b, _) = (jnp.moveaxis(each, 2, 0) for each in (pull, jerk))
    squared = jnp.minimum(jnp.maximum(((x * b - y * a) / size) ** 2 / rate, 1e-12), 1.0)
    level, z = jnp.sqrt(1.0 - squared), z / jnp.sqrt(size)
    is_met = (z < 0.0) & (-z >= level * jnp.cos(jnp.minimum(jnp.sqrt(rate) * step, 1.0)))
    top = jnp.where(is_met, rate * (1.0 + (1.0 + level) ** 2 / squared), rate)
    top = jnp.where(step > 0.0, top, 0.0)  # segments of absent targets have duration 0
    greatest = jnp.maximum(jnp.max(top), _rate_of_weak_thrust(pull, jerk, step))
    return relative(greatest / limits.body_rate**2 - 1.0)


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=-1)


def _rate_of_weak_thrust(pull: Array, jerk: Array, step: Array) -> Array:
    """Return the squared turning rate w^2 () at the greatest peak between two samples.

    The thrust per mass f has the samples `pull` (P, K + 1, 3), and between two of them, `step` (P,
    1) [s] apart, it is the cubic function with the derivatives `jerk`. The rate peaks where |f| is
    least. An estimate selects one interval, in which Gauss-Newton steps minimise |f|.
    """
    slopes = jerk * step[..., None]
    start, way = pull[:, :-1], pull[:, 1:] - pull[:, :-1]
    first, last = slopes[:, :-1], slopes[:, 1:]
    curve = [start, first, 3.0 * way - 2.0 * first - last, first + last - 2.0 * way]
    share = jnp.clip(-_dot(start, way) / at_least(_dot(way, way), 1e-6), 0.0, 1.0)
    share, peak = _approach_least(curve, share)
    per_time = jnp.broadcast_to(jnp.where(step > 0.0, 1.0 / step**2, 0.0), peak.shape)
    chosen = jnp.argmax(peak * per_time)
    get = lambda x: x.at[chosen].get(mode="promise_in_bounds")  # noqa: E731
    curve, share = [get(each.reshape(-1, 3)) for each in curve], get(share.ravel())
    for _ in range(_WEAK_STEPS):
        share, peak = _approach_least(curve, share)
    return peak * get(per_time.ravel())


def _approach_least(curve: list[Array], share: Array) -> tuple[Array, Array]:
    """Return the `share` in [0, 1] after a Gauss-Newton step to the least |f|, and a squared rate.

    `curve` has the coefficients (..., 3) of the cubic function f of the share, constant first. The
    squared rate is  |f'|^4 / |f x f'|^2 , where the tangent has its least |f|. If this place is not
    in [0, 1], it is the squared rate  |f x f'|^2 / |f|^4  at the given share.
    """
    u = share[..., None]
    f = curve[0] + u * (curve[1] + u * (curve[2] + u * curve[3]))
    slope = curve[1] + u * (2.0 * curve[2] + 3.0 * u * curve[3])
    mixed, speed, size = _dot(f, slope), _dot(slope, slope) + 1e-6, _dot(f, f)
    apart, nearest = size * speed - mixed * mixed, share - mixed / speed
    after, rate = jnp.clip(nearest, 0.0, 1.0), apart / at_least(size, 1e-8) ** 2
    return after, jnp.where(after == nearest, speed**2 / jnp.maximum(apart, 1e-8 * speed), rate)


def greatest_excess(
    maps: ProportionalMinco, nodes: int, columns: Array, durations: Array, case: QuadrotorCase
) -> list[Array]:
    """Return the greatest relative excess over each limit: an array (N,) for N segments of a plan.

    `columns` (N, C, 3), scaled end states and waypoint offsets, and mean piece durations
    `durations` (N,) [s] determine the segments. A piece has `nodes` intervals between samples, and
    estimates of peaks between the samples are included.
    """
    along = flight_along(maps, nodes, dataclasses.replace(case, extras=()), 0.0, 1.0)
    greatest = greatest_along(along, columns, durations, (case.gravity, case.limits, ()))
    extras = jax.vmap(functools.partial(greatest_extras, maps), in_axes=(0, 0, None))
    return [*relative_excess(case.limits, greatest), *extras(columns, durations, case.extras)]
