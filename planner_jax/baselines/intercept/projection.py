"""Projection of moving obstacles onto a path: quadrangles in the plane of station and time.

A station is a distance along the path. The car's body at a point of the path and a polygon in
uniform motion overlap during one time interval, which follows from the separating axis theorem.
These intervals of all points form a region in the plane of station and time. On a curved path the
region may consist of several runs, that is sequences of consecutive points. Each run is divided
into slabs of equal duration, and a quadrangle covers each slab. [Qu2022, Section IV-A] has
parallelograms, which is the shape on a straight path.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.baselines.intercept.path import Path
from planner_jax.baselines.intercept.station_time import Blocked, StationTimeProblem
from planner_jax.plane.obstacles import Obstacles
from planner_jax.robot.car import CarBody, CarLimits

# Slopes tried for a quadrangle's lower and upper edge, in units of its range of stations (distances
# along the path) divided by its duration.
_SLOPES = np.linspace(-2.0, 2.0, 17)
_BEFORE = 0.05  # blocked times, maybe infinite, are cut at -0.05 and 1.05 times the horizon


@dataclasses.dataclass(frozen=True)
class Projection:
    """Settings: how finely quadrangles cover the path positions and times that obstacles block."""

    runs: int = 2  # number of sequences of blocked points per obstacle; later ones join the last
    slabs: int = 4  # number of quadrangles of equal duration for one sequence
    margin: float = 0.01  # [m], least distance of the body from obstacles


def station_time_problem(
    path: Path,
    movers: Obstacles,
    body: CarBody,
    limits: CarLimits,
    horizon: Array,
    speed: Array,
    projection: Projection = Projection(),
    slack: float = 0.0,
) -> StationTimeProblem:
    """Return the problem of reaching the end of a path in time, among moving obstacles.

    The car starts without acceleration [Qu2022, Section V-C].

    Args:
        path: path of the rear axle.
        movers: moving obstacles.
        body: body of the car.
        limits: limits of the car.
        horizon: () [s], when the car must be at the end of the path.
        speed: () [m/s], speed of the car at time 0.
        projection: settings of the projection.
        slack: fraction of every limit that stays unused.
    """
    return StationTimeProblem(
        end_station=path.length,
        horizon=horizon,
        initial_speed=speed,
        initial_acceleration=jnp.zeros_like(horizon),
        speed_limit=speed_limits(path, body, limits) * (1.0 - slack),
        acceleration_limit=limits.acceleration * (1.0 - slack),
        blocked=project_obstacles(path, movers, body, horizon, projection),
    )


def speed_limits(path: Path, body: CarBody, limits: CarLimits) -> Array:
    """Return the greatest speed between every two neighbouring points of a path, (N - 1,) [m/s].

    It is the least of three: the car's speed limit; the speed at which the lateral acceleration
    reaches its limit on this curvature [Qu2022, eq. 23]; and the speed at which the steering angle
    changes at its greatest rate.
    """
    step = path.length / (path.curvature.shape[0] - 1)
    bend = jnp.maximum(jnp.abs(path.curvature[1:]), jnp.abs(path.curvature[:-1]))
    lateral = jnp.sqrt(limits.lateral_acceleration / jnp.maximum(bend, 1e-6))
    # The steering angle is atan(L kappa) for wheelbase L and curvature kappa. Its derivative by
    # kappa, L / (1 + L^2 kappa^2), is greatest at the smallest |kappa|.
    before, after = path.curvature[:-1], path.curvature[1:]
    least = jnp.where(before * after > 0.0, jnp.minimum(before**2, after**2), 0.0)
    gain = body.wheelbase / (1.0 + body.wheelbase**2 * least)
    steering = limits.steering_rate * step / jnp.maximum(gain * jnp.abs(after - before), 1e-9)
    return jnp.minimum(limits.speed, jnp.minimum(lateral, steering))


def project_obstacles(
    path: Path, movers: Obstacles, body: CarBody, horizon: Array, projection: Projection
) -> Blocked:
    """Return the quadrangles that cover all times and stations at which M obstacles block a path.

    A station is a distance along the path. Each obstacle has `projection.runs` sequences of
    consecutive blocked path points, and `projection.slabs` quadrangles for each sequence.
    """
    half_step = 0.5 * path.length / (path.curvature.shape[0] - 1)
    begin, finish = overlap(path, movers, body, half_step, projection.margin)
    first, last = -_BEFORE * horizon, (1.0 + _BEFORE) * horizon
    begin, finish = jnp.maximum(begin, first), jnp.minimum(finish, last)
    is_blocked = (begin < finish) & (finish > 0.0) & (begin < horizon)  # (M, N)
    before = jnp.pad(is_blocked, ((0, 0), (1, 0)))[:, :-1]
    run = jnp.minimum(jnp.cumsum(is_blocked & ~before, axis=1), projection.runs)
    station = jnp.linspace(0.0, 1.0, path.curvature.shape[0]) * path.length

    def cover(own: Array, begin: Array, finish: Array) -> Blocked:
        return _cover_run(own, begin, finish, station, half_step, projection.slabs)

    of_runs = jax.vmap(cover, in_axes=(0, None, None))
    own = is_blocked[:, None] & (run[:, None] == 1 + np.arange(projection.runs)[None, :, None])
    covers = jax.vmap(of_runs)(own, begin, finish)  # (M, runs, slabs)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[3:]), covers)


def overlap(
    path: Path, movers: Obstacles, body: CarBody, half_step: Array, margin: float
) -> tuple[Array, Array]:
    """Return when the body overlaps M obstacles at N path points: start and end [s], (M, N) each.

    The body is enlarged by `margin` [m]. A further enlargement makes the interval of a path point
    hold for all positions on the path within `half_step` () [m] of this point. Without an overlap
    the interval starts after its end. For a standing obstacle the interval may be infinite.
    """
    turned = half_step * jnp.abs(path.curvature)
    ahead, behind = body.length - body.rear_overhang, body.rear_overhang
    half = 0.5 * body.width
    along = margin + half_step + half * turned
    ahead, behind = ahead + along, behind + along
    half = half + margin + jnp.maximum(ahead, behind) * turned  # (N,)
    cos, sin = jnp.cos(path.heading), jnp.sin(path.heading)
    signs = [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)]
    own = jnp.stack(  # (4, N, 2), corners of the body
        [
            path.pos
            + jnp.where(a > 0.0, ahead, -behind)[:, None] * jnp.stack([cos, sin], axis=1)
            + (b * half)[:, None] * jnp.stack([-sin, cos], axis=1)
            for a, b in signs
        ]
    )
    theirs = movers.centre[:, None] + movers.corners  # (M, V, 2)
    edge = theirs - jnp.roll(theirs, 1, axis=1)
    size = jnp.sqrt(jnp.maximum(jnp.sum(edge**2, axis=2), 1e-12))
    begin = jnp.full((theirs.shape[0], cos.shape[0]), -jnp.inf, cos.dtype)
    finish = -begin

    def narrow(interval: tuple, x: Array, y: Array, is_axis: Array) -> tuple:
        mine = [x * corner[None, :, 0] + y * corner[None, :, 1] for corner in own]
        other = [x * theirs[:, k, :1] + y * theirs[:, k, 1:] for k in range(theirs.shape[1])]
        rate = x * movers.velocity[:, :1] + y * movers.velocity[:, 1:]
        before = _most(mine) - _least(other)
        after = _most(other) - _least(mine)
        is_still = jnp.abs(rate) < 1e-7
        is_apart = is_still & ((before <= 0.0) | (after <= 0.0))
        safe = jnp.where(is_still, 1.0, rate)
        ends = before / safe, -after / safe
        low = jnp.where(is_still, -jnp.inf, jnp.minimum(*ends))
        high = jnp.where(is_still, jnp.inf, jnp.maximum(*ends))
        low, high = jnp.where(is_apart, jnp.inf, low), jnp.where(is_apart, -jnp.inf, high)
        low, high = jnp.where(is_axis, low, -jnp.inf), jnp.where(is_axis, high, jnp.inf)
        return jnp.maximum(interval[0], low), jnp.minimum(interval[1], high)

    found = begin, finish
    for k in range(theirs.shape[1]):
        normal = edge[:, k] / size[:, k, None]
        found = narrow(found, normal[:, 1:], -normal[:, :1], size[:, k, None] > 1e-5)
    for x, y in ((cos, sin), (-sin, cos)):
        found = narrow(found, x[None], y[None], jnp.ones((1, 1), bool))
    begin, finish = found
    return jnp.where(movers.present[:, None], begin, jnp.inf), finish


def _most(values: list[Array]) -> Array:
    return jnp.max(jnp.stack(values), axis=0)


def _least(values: list[Array]) -> Array:
    return jnp.min(jnp.stack(values), axis=0)


def _cover_run(
    own: Array, begin: Array, finish: Array, station: Array, half_step: Array, slabs: int
) -> Blocked:
    any_own = jnp.any(own)
    first = jnp.min(jnp.where(own, begin, jnp.inf))
    last = jnp.max(jnp.where(own, finish, -jnp.inf))
    first, last = jnp.where(any_own, first, 0.0), jnp.where(any_own, last, 1.0)
    width = jnp.maximum(last - first, 1e-3) / slabs
    start = first + width * jnp.arange(slabs)
    middle = (start + 0.5 * width)[:, None]
    begin, finish = begin[None], finish[None]
    is_in = own[None] & (begin < start[:, None] + width) & (finish > start[:, None])  # (slabs, N)
    # Every path point blocks a rectangle of station and time. `left` and `right` are the times of
    # its sides, relative to the middle of the slab (time interval).
    left = jnp.clip(begin - middle, -0.5 * width, 0.5 * width)
    right = jnp.clip(finish - middle, -0.5 * width, 0.5 * width)

    def edge(side: float) -> Array:
        height = side * station + half_step
        highest = jnp.max(jnp.where(is_in, height, -jnp.inf), axis=1)
        lowest = jnp.min(jnp.where(is_in, height, jnp.inf), axis=1)
        spread = jnp.where(jnp.isfinite(highest), highest - lowest, 0.0)
        slope = spread[:, None] / width * _SLOPES.astype(station.dtype)[None]  # (slabs, slopes)
        above = jnp.maximum(
            height[None, None] - slope[..., None] * left[:, None],
            height[None, None] - slope[..., None] * right[:, None],
        )
        most = jnp.max(jnp.where(is_in[:, None], above, -jnp.inf), axis=2)
        best = jnp.argmin(most, axis=1)[:, None]
        level, rise = (jnp.take_along_axis(each, best, axis=1) for each in (most, slope))
        return side * (level + rise * (0.5 * width) * np.array([[-1.0, 1.0]], station.dtype))

    present = jnp.any(is_in, axis=1)
    lower, upper = edge(-1.0), edge(1.0)
    return Blocked(
        start=start,
        end=start + width,
        lower=jnp.where(present[:, None], lower, 0.0),
        upper=jnp.where(present[:, None], upper, 1.0),
        present=present,
    )
