"""Cases of the task `intercept`: a car, a moving target, and obstacles, in the plane."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import DTypeLike
from numpy.typing import ArrayLike

from planner_jax.ball.prediction import PathTable
from planner_jax.core import rules
from planner_jax.core.checks import floating, numbers_of, require_numeric, shape_of
from planner_jax.core.errors import ArgumentError
from planner_jax.core.paths import require_path
from planner_jax.core.rules import Field, Table, require_sound
from planner_jax.plane.make_obstacles import Circle, obstacles
from planner_jax.plane.obstacles import Obstacles
from planner_jax.plane.polygons import Geometry, Polygon
from planner_jax.plane.target import PlanePath, PositionPath, move_path
from planner_jax.robot.car import CarBody, CarLimits
from planner_jax.task.arguments import array_of, batch_of

_BODY, _LIMITS = ([field.name for field in dataclasses.fields(c)] for c in (CarBody, CarLimits))
# The speed limits allow an initial speed that was rounded.
_DRIVABLE = rules.Rule(
    "from -reverse_speed to the greatest speed of the car",
    lambda value, case: (
        (value <= 1.001 * case.limits.speed) & (value >= 1.001 * case.limits.least_speed)
    ),
)

# Shapes, types and ranges that `pj.require_sound` checks for the arrays of an `InterceptCase`.
RULES: Table = (
    Field("start", (3,)),
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
    *(
        Field(f"{group}.{name}", (letter,), rules.NOT_NEGATIVE)
        for group, letter in (("walls", "W"), ("movers", "M"))
        for name in ("radius", "growth")
    ),
    *(
        Field(f"movers.track.{name}", shape)
        for name, shape in (("poses", ("M", "K", 3)), ("begin", ("M",)), ("end", ("M",)))
    ),
    Field("movers.track.step", ("M",), rules.POSITIVE),
    Field("region", ("V", 2)),
    Field("earliest", (), rules.NOT_NEGATIVE),
    Field("end_speed", (2,), rules.NUMBER),
    Field("margin", (), rules.NOT_NEGATIVE),
    Field("map_heading", ()),
    Field("origin", (2,)),
    Field("lower", (2,), rules.below_or_infinite("upper")),
    Field("upper", (2,), rules.NUMBER),
    *(Field(f"body.{name}", (), rules.POSITIVE) for name in _BODY if name != "rear_overhang"),
    Field("body.rear_overhang", ()),
    *(
        Field(f"limits.{name}", (), rules.POSITIVE_OR_NONE)
        for name in _LIMITS
        if name != "reverse_speed"
    ),
    Field("limits.reverse_speed", (), rules.NOT_NEGATIVE_OR_NONE),
    Field("speed", (), _DRIVABLE),
)
# Maps a field of a case to the argument of `case` that sets it; error messages name the argument.
_ARGUMENTS = {
    "speed": "initial_speed",
    "curvature": "initial_curvature",
    **{f"movers.track.{name}": "mover_paths" for name in ("poses", "begin", "step", "end")},
    "movers.growth": "mover_growth",
    **{f"body.{name}": name for name in _BODY},
    **{f"limits.{name}": name for name in _LIMITS},
}


@struct.dataclass
class InterceptCase:
    """One interception to plan, or a batch of cases; every number is a leaf of the pytree.

    The middle of the car's body has to come within `tolerance` of the target, or of the region
    around it, at the time of the meeting. World frame in the plane, SI units, positions relative to
    `origin`. Time 0 is when the car starts to drive.

    Attributes:
        start: (3,) x [m], y [m] of the rear axle's middle and heading [rad] at time 0.
        speed: () [m/s], speed of the car at time 0, negative in reverse.
        curvature: () [1/m], curvature of the rear axle's path at time 0, from the steering angle.
        target: expected path of the target.
        time: () [s], time of the meeting; the latest time for planners that choose the time.
        tolerance: () [m], greatest distance of the body's middle from the target at `time`.
        end_heading: () [rad], required heading of the car at the meeting.
        heading_tolerance: () [rad], greatest deviation from `end_heading`; pi: any heading.
        walls: static obstacles.
        movers: moving obstacles.
        lower: (2,) [m], corner of the map; the body's middle must not leave the map.
        upper: (2,) [m], the opposite corner.
        body: rectangle of the car's body.
        limits: limits of the car's motion.
        region: (V, 2) [m], convex polygon around the target; all 0: the target itself.
        earliest: () [s], earliest time of a meeting, for planners that choose the time.
        end_speed: (2,) [m/s], least and greatest speed of the car at the meeting.
        margin: () [m], least distance of the body from obstacles.
        map_heading: () [rad], direction of the axes of `lower` and `upper`.
        origin: (2,) [m], world position to which all positions of the case are relative.
    """

    rules: ClassVar[Table] = RULES

    start: Array
    speed: Array
    curvature: Array
    target: PlanePath
    time: Array
    tolerance: Array
    end_heading: Array
    heading_tolerance: Array
    walls: Obstacles
    movers: Obstacles
    lower: Array
    upper: Array
    body: CarBody
    limits: CarLimits
    region: Array
    earliest: Array
    end_speed: Array
    margin: Array
    map_heading: Array
    origin: Array

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
    walls: Sequence[Polygon | Circle] | Geometry | Obstacles = (),
    movers: Sequence[Polygon | Circle] | Geometry | Obstacles = (),
    mover_velocities: ArrayLike = 0.0,
    mover_paths: Sequence[object] | None = None,
    mover_growth: ArrayLike = 0.0,
    tolerance: ArrayLike = 0.05,
    region: ArrayLike = (),
    earliest: ArrayLike = 0.0,
    end_heading: ArrayLike | None = None,
    heading_tolerance: ArrayLike = 0.05,
    end_speed: ArrayLike = (-np.inf, np.inf),
    margin: ArrayLike = 0.0,
    lower: ArrayLike = (0.0, 0.0),
    upper: ArrayLike = (8.0, 8.0),
    map_heading: ArrayLike = 0.0,
    origin: ArrayLike | None = None,
    length: ArrayLike = 0.4,
    width: ArrayLike = 0.25,
    wheelbase: ArrayLike = 0.3,
    rear_overhang: ArrayLike = 0.05,
    speed: ArrayLike = 1.5,
    acceleration: ArrayLike = 1.0,
    lateral_acceleration: ArrayLike = 0.8,
    curvature: ArrayLike = 2.0,
    steering_rate: ArrayLike = 2.0,
    reverse_speed: ArrayLike = 0.0,
    jerk: ArrayLike = np.inf,
    dtype: DTypeLike = jnp.float32,
) -> InterceptCase:
    """Make one case of an interception [Qu2022, eq. 6], or a batch.

    The paper states a map of 80 x 80 pixels, a meeting after 10 s, and 0.5 m/s at the start
    (Section V). This library assumes that the map is 8 m x 8 m and the car a model of scale 1:10.

    Args:
        target: path of the target, such as a `TurningPath`; in a batch every leaf has an axis B.
        time: () or (B,) [s], of the meeting, > 0. The time and every following number is one value
            for all cases, or one value for each case.
        start: (3,) x, y of the rear axle's middle [m], and heading [rad], at time 0.
        initial_speed: [m/s], speed at time 0, negative in reverse; within the car's limits.
        initial_curvature: [1/m], curvature of the rear axle's path at time 0.
        walls: static obstacles: polygons with V corners (V, 2) [m], `Circle`s, or geometries of
            Shapely, which all cases share; or `Obstacles` with the batch's axes on every leaf.
            Polygons need not be convex, since `pj.obstacles` cuts them into convex parts.
        movers: moving obstacles at time 0, as polygons or `Obstacles`, like the walls.
        mover_velocities: (2,) or (N, 2) [m/s], of the N polygons in `movers`.
        mover_paths: for each polygon in `movers` None, or its recorded motion: increasing times
            (K,) [s], and its poses (K, 3) at these times: x, y [m] and heading [rad]. The corners
            of such a polygon are in its own frame, relative to x, y, at heading 0. It exists from
            its first to its last time only, and its pose is linear in time between two times.
        mover_growth: () or (N,) [m/s], rate at which each mover grows on all sides after time 0,
            because its motion is uncertain.
        tolerance: [m], greatest distance of the body's middle from the target, or from the region,
            at the meeting.
        region: (V, 2) [m], corners of a convex polygon relative to the target, counter-clockwise or
            clockwise. The body's middle has to be in this region at the meeting. By default the
            region is the target's position.
        earliest: [s], earliest time of the meeting, for planners that choose the time.
        end_heading: [rad], heading of the car at the meeting; by default any heading.
        heading_tolerance: [rad], greatest deviation from `end_heading`.
        end_speed: (2,) [m/s], least and greatest speed of the car at the meeting; (0, 0) is a stop.
        margin: [m], distance from every obstacle that the car's body has to keep.
        lower: (2,) [m], corner of the map, in the axes of the map. It may be -inf.
        upper: (2,) [m], the opposite corner. It may be inf.
        map_heading: [rad], direction of the map's first axis. The map's axes pass through the
            world's origin.
        origin: (2,) [m], world position that is subtracted from every position in float64, before
            positions are rounded to `dtype`. By default it is 0 if `dtype` can represent the start
            to 1 % of the tolerance, and else the start itself. The map's axes then pass through
            this position. Targets of your own classes must return positions relative to it.
        length: [m], of the body.
        width: [m], of the body.
        wheelbase: [m], distance between the axles.
        rear_overhang: [m], distance of the body's rear end behind the rear axle.
        speed: [m/s], greatest speed.
        acceleration: [m/s^2], greatest magnitude of the acceleration along the path.
        lateral_acceleration: [m/s^2], greatest magnitude of speed^2 * curvature.
        curvature: [1/m], greatest magnitude of the curvature.
        steering_rate: [rad/s], greatest rate of the steering angle.
        reverse_speed: [m/s], greatest speed in reverse. With 0 for all cases the car has no reverse
            gear, and planning is faster.
        jerk: [m/s^3], greatest magnitude of the longitudinal jerk: the change of the acceleration
            from one piece of the plan to the next, divided by a piece's duration. The acceleration
            at time 0 is not limited by it.
        dtype: type of every floating leaf.

    Raises:
        ValueError: the edges of a polygon cross, or an array has a wrong shape or an invalid value.
    """
    dtype, shapes = floating(dtype), [batch_of("start", start, 3)]
    scalars = {"time": time, "initial_speed": initial_speed, "tolerance": tolerance}
    shapes += [batch_of(name, value) for name, value in scalars.items()]
    batch = max(shapes, key=len)
    shift = _find_origin(start, tolerance, origin, dtype)

    leaf = functools.partial(array_of, batch=batch, dtype=dtype)

    def corner(name: str, value: ArrayLike) -> np.ndarray:
        both = value if shape_of(name, value) else np.full(2, value, np.float64)
        return np.asarray(numbers_of(name, both, batch, (2,)), np.float64) - shift

    is_bare = require_path("target", target, batch, 2)
    is_free = end_heading is None
    around = leaf("heading_tolerance", heading_tolerance)
    body = (length, width, wheelbase, rear_overhang)
    has_reverse = bool(np.any(require_numeric("reverse_speed", reverse_speed) != 0.0))
    limits = {
        "speed": speed,
        "acceleration": acceleration,
        "lateral_acceleration": lateral_acceleration,
        "curvature": curvature,
        "steering_rate": steering_rate,
        **({"reverse_speed": reverse_speed} if has_reverse else {}),
        **({"jerk": jerk} if np.any(require_numeric("jerk", jerk) != np.inf) else {}),
    }
    moved = functools.partial(_make_obstacles, origin=shift, batch=batch, dtype=dtype)
    movement = {"velocities": mover_velocities, "paths": mover_paths, "growth": mover_growth}
    result = InterceptCase(
        start=leaf("start", np.asarray(start, np.float64) - [*shift, 0.0], 3),
        speed=leaf("initial_speed", initial_speed),
        curvature=leaf("initial_curvature", initial_curvature),
        target=_move_target(PositionPath(target) if is_bare else target, shift, origin is None),
        time=leaf("time", time),
        tolerance=leaf("tolerance", tolerance),
        end_heading=leaf("end_heading", 0.0 if is_free else end_heading),
        heading_tolerance=jnp.full_like(around, np.pi) if is_free else around,
        walls=moved("walls", walls),
        movers=moved("movers", movers, **movement),
        lower=leaf("lower", corner("lower", lower), 2),
        upper=leaf("upper", corner("upper", upper), 2),
        body=CarBody(*map(leaf, _BODY, body)),
        limits=CarLimits(**{name: leaf(name, value) for name, value in limits.items()}),
        region=_make_region(region, batch, dtype),
        earliest=leaf("earliest", earliest),
        end_speed=leaf("end_speed", end_speed, 2),
        margin=leaf("margin", margin),
        map_heading=leaf("map_heading", map_heading),
        origin=leaf("origin", shift, 2),
    )
    require_sound(result, _ARGUMENTS)
    return result


def _find_origin(
    start: ArrayLike, tolerance: ArrayLike, origin: ArrayLike | None, dtype: DTypeLike
) -> np.ndarray:
    """Return the position (2,) float64 to which the positions of a case are relative.

    It is rounded to a number of the type `dtype`, so that the case stores it exactly.
    """
    if origin is None:
        starts = np.asarray(start, np.float64).reshape(-1, 3)[:, :2]
        rounding = float(np.finfo(dtype).eps) * np.abs(starts).max(initial=0.0)
        is_exact = rounding <= 0.01 * np.min(np.asarray(tolerance, np.float64))
        origin = np.zeros(2) if is_exact or not np.isfinite(starts).all() else starts[0]
    elif shape_of("origin", origin) != (2,):
        raise ArgumentError("origin", "the shape (2,)", np.shape(origin), verb="have")
    return np.asarray(origin, np.float64).astype(dtype).astype(np.float64)


def _move_target(target: PlanePath, origin: np.ndarray, is_chosen: bool) -> PlanePath:
    """Return a target's path with positions relative to `origin` (2,) float64 [m]."""
    if not origin.any():
        return target
    if isinstance(target, PathTable):
        pos = np.asarray(target.pos, np.float64) - origin
        return dataclasses.replace(target, pos=jnp.asarray(pos, np.asarray(target.vel).dtype))
    moved = move_path(target, -origin)
    if moved is target and is_chosen:
        rule = "relative to the argument origin, which a class of your own needs far from (0, 0)"
        raise ArgumentError("target", rule, shown=f"a {type(target).__name__}")
    return moved


def _make_obstacles(
    name: str,
    polygons: Sequence[Polygon | Circle] | Geometry | Obstacles,
    *,
    origin: np.ndarray,
    batch: tuple[int, ...],
    dtype: DTypeLike,
    **movement: Any,
) -> Obstacles:
    if isinstance(polygons, Obstacles):
        if origin.any():
            raise ArgumentError(name, "polygons if the case has an origin", shown="Obstacles")
        return polygons
    try:
        one = obstacles(polygons, origin=origin, dtype=dtype, **movement)
    except ArgumentError as error:
        names = {"polygons": name, **{key: f"mover_{key}" for key in movement}}
        raise error.with_names(names) from None
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, batch + leaf.shape), one)


def _make_region(region: ArrayLike, batch: tuple[int, ...], dtype: DTypeLike) -> Array:
    if 0 in shape_of("region", region):
        return jnp.zeros((*batch, 1, 2), dtype)
    try:
        one = obstacles([region], dtype=dtype)
    except ArgumentError as error:
        raise error.with_names({"polygons": "region"}) from None
    corners = one.corners[0] + one.centre[:1]
    return jnp.broadcast_to(corners, batch + corners.shape)
