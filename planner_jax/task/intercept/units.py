"""Units of an interception: the frame and the scales in which its planners compute.

The planners' grids, margins, weights and tolerances are plain numbers. They suit a car that is 0.4
long, accelerates by at most 1, and starts at the origin along the x axis. A case is converted to
these units before it is planned, and the plan is converted back. Therefore a problem in
millimetres, far from the world's origin, or rotated, gets the same plan.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.plane.obstacles import Obstacles
from planner_jax.plane.target import ScaledPath, rotate
from planner_jax.robot.car import CarBody, CarLimits
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan

_LENGTH = 0.4  # length of the car's body in the units
_ACCELERATION = 1.0  # greatest acceleration of the car in the units
_ABRUPT = 1e3  # acceleration that stands for an infinite one, in the units


@struct.dataclass
class Units:
    """The frame and the units of length and time of one case."""

    frame: Array  # (3,) x [m], y [m] and heading [rad] of the rear axle at the start
    length: Array  # () [m]
    time: Array  # () [s]

    @property
    def speed(self) -> Array:
        """Unit of speed, () [m/s]."""
        return self.length / self.time

    @property
    def acceleration(self) -> Array:
        """Unit of acceleration, () [m/s^2]."""
        return self.length / self.time**2


def units_of(case: InterceptCase) -> Units:
    """Return the units of a case, by its start, the length of its car and its acceleration.

    If the acceleration is not limited, its place is taken by the lateral acceleration, and without
    a limit of it by the acceleration that covers 100 units of length in the time of the case.
    """
    length, limits = case.body.length / _LENGTH, case.limits
    usual = 100.0 * length / case.time**2
    lateral = limits.lateral_acceleration
    other = jnp.where(jnp.isfinite(lateral), lateral, usual)
    acceleration = jnp.where(jnp.isfinite(limits.acceleration), limits.acceleration, other)
    return Units(case.start, length, jnp.sqrt(length * _ACCELERATION / acceleration))


def enter_units(case: InterceptCase, units: Units) -> InterceptCase:
    """Convert a case to units: its start is at the origin, and its car is 0.4 long.

    An infinite speed limit is replaced by a speed that the car cannot reach.
    """
    turn, origin = -units.frame[2], units.frame[:2]
    body, limits = case.body, case.limits
    to_map = rotate(origin, -case.map_heading)
    acceleration = _divide(limits.acceleration, units.acceleration)
    gained = jnp.minimum(acceleration, _ABRUPT) * case.time / units.time
    reachable = 1.1 * (jnp.abs(case.speed) / units.speed + gained)
    bound = lambda speed: jnp.minimum(_divide(speed, units.speed), reachable)  # noqa: E731
    reverse, jerk = limits.reverse_speed, limits.jerk
    return dataclasses.replace(
        case,
        start=jnp.zeros_like(case.start),
        speed=case.speed / units.speed,
        curvature=case.curvature * units.length,
        target=ScaledPath(case.target, units.frame, units.length, units.time),
        time=case.time / units.time,
        tolerance=case.tolerance / units.length,
        end_heading=case.end_heading + turn,
        walls=_enter_obstacles(case.walls, units),
        movers=_enter_obstacles(case.movers, units),
        lower=_divide(case.lower - to_map, units.length),
        upper=_divide(case.upper - to_map, units.length),
        body=CarBody(
            length=body.length / units.length,
            width=body.width / units.length,
            wheelbase=body.wheelbase / units.length,
            rear_overhang=body.rear_overhang / units.length,
        ),
        limits=CarLimits(
            speed=bound(limits.speed),
            acceleration=acceleration,
            lateral_acceleration=_divide(limits.lateral_acceleration, units.acceleration),
            curvature=_divide(limits.curvature, 1.0 / units.length),
            steering_rate=_divide(limits.steering_rate, 1.0 / units.time),
            reverse_speed=None if reverse is None else bound(reverse),
            jerk=None if jerk is None else _divide(jerk, units.acceleration / units.time),
        ),
        region=rotate(case.region, turn) / units.length,
        earliest=case.earliest / units.time,
        end_speed=_divide(case.end_speed, units.speed),
        margin=case.margin / units.length,
        map_heading=case.map_heading + turn,
        origin=jnp.zeros_like(case.origin),
    )


def _divide(value: Array, unit: Array) -> Array:
    """Divide by a unit; an infinite value stays infinite, and its derivatives are 0, not NaN."""
    is_finite = jnp.isfinite(value)
    return jnp.where(is_finite, jnp.where(is_finite, value, 0.0) / unit, value)


def _enter_obstacles(group: Obstacles, units: Units) -> Obstacles:
    turn, origin, length = -units.frame[2], units.frame[:2], units.length
    track = group.track
    corners = group.corners
    if track is None:
        corners = rotate(corners, turn)
    else:
        xy = rotate(track.poses[..., :2] - origin[None, None], turn) / length
        heading = track.poses[..., 2:] + turn
        track = dataclasses.replace(
            track,
            poses=jnp.concatenate([xy, heading], axis=-1),
            begin=track.begin / units.time,
            step=track.step / units.time,
            end=track.end / units.time,
        )
    return dataclasses.replace(
        group,
        centre=rotate(group.centre - origin[None], turn) / length,
        corners=corners / length,
        velocity=rotate(group.velocity, turn) / units.speed,
        radius=group.radius / length,
        growth=group.growth / units.speed,
        track=track,
    )


def leave_units(
    plan: InterceptPlan, case: InterceptCase, units: Units, *, is_early: bool
) -> InterceptPlan:
    """Convert a plan in units to the case's world frame and SI units.

    The plan's cost is its time if `is_early` is true, and else the integral of the squared
    acceleration.
    """
    scale = units.time if is_early else units.acceleration**2 * units.time
    return dataclasses.replace(
        plan,
        cost=plan.cost * scale,
        start=case.start,
        time=plan.time * units.time,
        speed=plan.speed * units.speed,
        curvature=plan.curvature / units.length,
        meeting=case.target.at(plan.time * units.time).pos,
        origin=case.origin,
    )
