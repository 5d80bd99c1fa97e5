"""Cases of the task `intercept`: a car, a moving target, and obstacles, in the plane."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import DTypeLike
from numpy.typing import ArrayLike

from planner_jax.core import rules
from planner_jax.core.checks import floating, require_path, shape_of
from planner_jax.core.errors import ArgumentError
from planner_jax.core.rules import Field, Table, require_sound
from planner_jax.plane.obstacles import Obstacles, obstacles
from planner_jax.plane.polygons import Geometry, Polygon
from planner_jax.plane.target import PlanePath
from planner_jax.robot.car import CarBody, CarLimits
from planner_jax.task.arguments import array_of, batch_of

_BODY, _LIMITS = ([field.name for field in dataclasses.fields(c)] for c in (CarBody, CarLimits))

# Shapes, types and ranges that `pj.require_sound` checks for the arrays of an `InterceptCase`.
RULES: Table = (
    Field("start", (3,)),
    Field("speed", (), rules.NOT_NEGATIVE),
    Field("curvature", ()),
    Field("time", (), rules.POSITIVE),
    Field("tolerance", (), rules.POSITIVE),
    Field("end_heading", ()),
    Field("heading_tolerance", (), rules.POSITIVE),
    *(
        Field(f"{group}.{name}", (letter, *shape), kind=kind)
        for group, letter in (("walls", "W"), ("movers", "M"))
        for name, shape, kind in (
            ("centre", (2,), np.floating),
            ("corners", (f"corners of {group}", 2), np.floating),
            ("velocity", (2,), np.floating),
            ("present", (), np.bool_),
        )
    ),
    Field("lower", (2,), rules.below("upper")),
    Field("upper", (2,)),
    *(Field(f"body.{name}", (), rules.POSITIVE) for name in _BODY if name != "rear_overhang"),
    Field("body.rear_overhang", ()),
    *(Field(f"limits.{name}", (), rules.POSITIVE_OR_NONE) for name in _LIMITS),
)
# Maps a field of a case to the argument of `case` that sets it; error messages name the argument.
_ARGUMENTS = {
    "speed": "initial_speed",
    "curvature": "initial_curvature",
    **{f"body.{name}": name for name in _BODY},
    **{f"limits.{name}": name for name in _LIMITS},
}


@struct.dataclass
class InterceptCase:
    """One interception to plan, or a batch of cases; every number is a leaf of the pytree.

    The middle of the car's body has to come within `tolerance` of the target at the time of the
    meeting. World frame in the plane, SI units. Time 0 is when the car starts to drive.
    """

    rules: ClassVar[Table] = RULES

    start: Array  # (3,) x [m], y [m] of the rear axle's middle and heading [rad] at time 0
    speed: Array  # () [m/s], of the car at time 0
    curvature: Array  # () [1/m], of the rear axle's path at time 0, from the steering angle
    target: PlanePath  # expected path of the target
    time: Array  # () [s], of the meeting; the latest time for planners that choose the time
    tolerance: Array  # () [m], greatest distance of the body's middle from the target at `time`
    end_heading: Array  # () [rad], required heading of the car at the meeting
    heading_tolerance: Array  # () [rad], greatest deviation from `end_heading`; pi: any heading
    walls: Obstacles  # static obstacles
    movers: Obstacles  # moving obstacles
    lower: Array  # (2,) [m], corner of the map; the body's middle must not leave the map
    upper: Array  # (2,) [m], the opposite corner
    body: CarBody
    limits: CarLimits

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the batch: () for one case, (B,) for a batch of B cases."""
        return np.shape(self.time)


def case(
    target: PlanePath,
    time: ArrayLike = 10.0,
    *,
    start: ArrayLike = (0.8, 4.0, 0.0),
    initial_speed: ArrayLike = 0.5,
    initial_curvature: ArrayLike = 0.0,
    walls: Sequence[Polygon] | Geometry | Obstacles = (),
    movers: Sequence[Polygon] | Geometry | Obstacles = (),
    mover_velocities: ArrayLike = 0.0,
    tolerance: ArrayLike = 0.05,
    end_heading: ArrayLike | None = None,
    heading_tolerance: ArrayLike = 0.05,
    lower: ArrayLike = (0.0, 0.0),
    upper: ArrayLike = (8.0, 8.0),
    length: ArrayLike = 0.4,
    width: ArrayLike = 0.25,
    wheelbase: ArrayLike = 0.3,
    rear_overhang: ArrayLike = 0.05,
    speed: ArrayLike = 1.5,
    acceleration: ArrayLike = 1.0,
    lateral_acceleration: ArrayLike = 0.8,
    curvature: ArrayLike = 2.0,
    steering_rate: ArrayLike = 2.0,
    dtype: DTypeLike = jnp.float32,
) -> InterceptCase:
    """Make one case of an interception, or a batch, by default with the numbers of [Qu2022].

    The paper states a map of 80 x 80 pixels, a meeting after 10 s, and 0.5 m/s at the start
    (Section V). This library assumes that the map is 8 m x 8 m and the car a model of scale 1:10.

    Args:
        target: path of the target, such as a `TurningPath`; in a batch every leaf has an axis B.
        time: () or (B,) [s], of the meeting, > 0. The time and every following number is one value
            for all cases, or one value for each case.
        start: (3,) x, y of the rear axle's middle [m], and heading [rad], at time 0.
        initial_speed: [m/s], speed at time 0.
        initial_curvature: [1/m], curvature of the rear axle's path at time 0.
        walls: static obstacles: polygons with V corners (V, 2) [m], or geometries of Shapely, which
            all cases share; or `Obstacles` with the batch's axes on every leaf. Polygons need not
            be convex, since `pj.obstacles` cuts them into convex parts.
        movers: moving obstacles at time 0, as polygons or `Obstacles`, like the walls.
        mover_velocities: (2,) or (N, 2) [m/s], of the N polygons in `movers`.
        tolerance: [m], greatest distance of the body's middle from the target at the meeting.
        end_heading: [rad], heading of the car at the meeting; by default any heading.
        heading_tolerance: [rad], greatest deviation from `end_heading`.
        lower: (2,) [m], corner of the map.
        upper: (2,) [m], the opposite corner.
        length: [m], of the body.
        width: [m], of the body.
        wheelbase: [m], distance between the axles.
        rear_overhang: [m], distance of the body's rear end behind the rear axle.
        speed: [m/s], greatest speed.
        acceleration: [m/s^2], greatest magnitude of the acceleration along the path.
        lateral_acceleration: [m/s^2], greatest magnitude of speed^2 * curvature.
        curvature: [1/m], greatest magnitude of the curvature.
        steering_rate: [rad/s], greatest rate of the steering angle.
        dtype: type of every floating leaf.

    Raises:
        ValueError: the edges of a polygon cross, or an array has a wrong shape or an invalid value.
    """
    dtype, shapes = floating(dtype), [batch_of("start", start, 3)]
    scalars = {"time": time, "initial_speed": initial_speed, "tolerance": tolerance}
    shapes += [shape_of(name, value) for name, value in scalars.items()]
    batch = max(shapes, key=len)

    leaf = functools.partial(array_of, batch=batch, dtype=dtype)
    require_path("target", target, batch, 2)
    is_free = end_heading is None
    around = leaf("heading_tolerance", heading_tolerance)
    body = (length, width, wheelbase, rear_overhang)
    limits = (speed, acceleration, lateral_acceleration, curvature, steering_rate)
    result = InterceptCase(
        start=leaf("start", start, 3),
        speed=leaf("initial_speed", initial_speed),
        curvature=leaf("initial_curvature", initial_curvature),
        target=target,
        time=leaf("time", time),
        tolerance=leaf("tolerance", tolerance),
        end_heading=leaf("end_heading", 0.0 if is_free else end_heading),
        heading_tolerance=jnp.full_like(around, np.pi) if is_free else around,
        walls=_make_obstacles("walls", walls, 0.0, batch, dtype),
        movers=_make_obstacles("movers", movers, mover_velocities, batch, dtype),
        lower=leaf("lower", lower, 2),
        upper=leaf("upper", upper, 2),
        body=CarBody(*map(leaf, _BODY, body)),
        limits=CarLimits(*map(leaf, _LIMITS, limits)),
    )
    require_sound(result, _ARGUMENTS)
    return result


def _make_obstacles(
    name: str,
    polygons: Sequence[Polygon] | Geometry | Obstacles,
    velocities: ArrayLike,
    batch: tuple[int, ...],
    dtype: DTypeLike,
) -> Obstacles:
    if isinstance(polygons, Obstacles):
        return polygons
    try:
        one = obstacles(polygons, velocities, dtype=dtype)
    except ArgumentError as error:
        names = {"polygons": name, "velocities": "mover_velocities"}
        raise error.with_names(names) from None
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, batch + leaf.shape), one)
