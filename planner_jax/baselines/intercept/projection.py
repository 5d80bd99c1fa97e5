"""What of a path moving obstacles block, and when, as quadrangles in the plane of station and time.

The body at a point of the path and a polygon that moves evenly overlap in one interval of time:
on every axis that may part them (their edges' normals) both cover intervals, one of which moves
evenly, and what is left when every axis has had its say is exact. Along the path these intervals
make up a region, which on a bent path can come in several runs. Each run is cut into slabs of
equal duration, and each slab covered by a quadrangle ([Qu2022, Section IV-A]: parallelograms,
which is what a straight path has).
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

_SLOPES = np.linspace(-2.0, 2.0, 17)  # that an edge may have, in heights of its slab by duration
_BEFORE = 0.05  # of the horizon, what is looked at before it begins and after it ends


@dataclasses.dataclass(frozen=True)
class Projection:
    """Sizes of a projection; static."""

    runs: int = 2  # of one obstacle; more than that are joined to the last one
    slabs: int = 4  # of one run
    margin: float = 0.01  # [m], that the body keeps from obstacles


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
    """The problem of driving along a path among moving obstacles, to be at its end in time.

    The car begins without acceleration [Qu2022, Section V-C].

    Args:
        path: of the rear axle, N points.
        movers: obstacles.
        body: of the car.
        limits: of the car.
        horizon: () [s].
        speed: () [m/s], at time 0.
        projection: sizes.
        slack: share of every limit that is kept free.
    """
    return StationTimeProblem(
        end_station=path.length,
        horizon=horizon,
        initial_speed=speed,
        initial_acceleration=jnp.zeros_like(horizon),
        speed_limit=speed_limits(path, body, limits) * (1.0 - slack),
        acceleration_limit=limits.acceleration * (1.0 - slack),
        blocked=blocked_by(path, movers, body, horizon, projection),
    )


def speed_limits(path: Path, body: CarBody, limits: CarLimits) -> Array:
    """The greatest speed between every two neighbours of a path, (N - 1,) [m/s].

    That of the car, that of its lateral acceleration, sqrt(a / |kappa|) [Qu2022, eq. 23], and
    that at which the steering angle changes at its greatest rate.
    """
    step = path.length / (path.curvature.shape[0] - 1)
    bend = jnp.maximum(jnp.abs(path.curvature[1:]), jnp.abs(path.curvature[:-1]))
    lateral = jnp.sqrt(limits.lateral_acceleration / jnp.maximum(bend, 1e-6))
    # The steering angle turns fastest where the curvature is least.
    before, after = path.curvature[:-1], path.curvature[1:]
    least = jnp.where(before * after > 0.0, jnp.minimum(before**2, after**2), 0.0)
    gain = body.wheelbase / (1.0 + body.wheelbase**2 * least)
    steering = limits.steering_rate * step / jnp.maximum(gain * jnp.abs(after - before), 1e-9)
    return jnp.minimum(limits.speed, jnp.minimum(lateral, steering))


def blocked_by(
    path: Path, movers: Obstacles, body: CarBody, horizon: Array, projection: Projection
) -> Blocked:
    """Quadrangles that cover what moving obstacles (M) block, P = M * runs * slabs of them."""
    half_step = 0.5 * path.length / (path.curvature.shape[0] - 1)
    begin, finish = overlap(path, movers, body, half_step, projection.margin)
    first, last = -_BEFORE * horizon, (1.0 + _BEFORE) * horizon
    begin, finish = jnp.maximum(begin, first), jnp.minimum(finish, last)
    is_blocked = (begin < finish) & (finish > 0.0) & (begin < horizon)  # (M, N)
    before = jnp.pad(is_blocked, ((0, 0), (1, 0)))[:, :-1]
    run = jnp.minimum(jnp.cumsum(is_blocked & ~before, axis=1), projection.runs)
    station = jnp.linspace(0.0, 1.0, path.curvature.shape[0]) * path.length

    def cover(own: Array, begin: Array, finish: Array) -> Blocked:
        return _covered(own, begin, finish, station, half_step, projection.slabs)

    of_runs = jax.vmap(cover, in_axes=(0, None, None))
    own = is_blocked[:, None] & (run[:, None] == 1 + np.arange(projection.runs)[:, None])
    covers = jax.vmap(of_runs)(own, begin, finish)  # (M, runs, slabs)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[3:]), covers)


def overlap(
    path: Path, movers: Obstacles, body: CarBody, half_step: Array, margin: float
) -> tuple[Array, Array]:
    """From when to when [s] the body overlaps obstacles at points of a path, (M, N) each.

    The body is so much larger that the interval holds for half a step before and after the point.
    Where there is none it begins after its end; of an obstacle that stands it may be infinite.
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
        """What an axis for every obstacle and point, x and y (M, 1) or (1, N), leaves of it."""
        mine = [x * corner[:, 0] + y * corner[:, 1] for corner in own]
        other = [x * theirs[:, k, :1] + y * theirs[:, k, 1:] for k in range(theirs.shape[1])]
        rate = x * movers.velocity[:, :1] + y * movers.velocity[:, 1:]
        # They overlap while -behind < rate t < before.
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


def _covered(
    own: Array, begin: Array, finish: Array, station: Array, half_step: Array, slabs: int
) -> Blocked:
    """Quadrangles (slabs,) over the points `own` (N,) of a path, blocked from begin to finish."""
    any_own = jnp.any(own)
    first = jnp.min(jnp.where(own, begin, jnp.inf))
    last = jnp.max(jnp.where(own, finish, -jnp.inf))
    first, last = jnp.where(any_own, first, 0.0), jnp.where(any_own, last, 1.0)
    width = jnp.maximum(last - first, 1e-3) / slabs
    start = first + width * jnp.arange(slabs)
    middle = (start + 0.5 * width)[:, None]
    is_in = own & (begin < start[:, None] + width) & (finish > start[:, None])  # (slabs, N)
    # Every point blocks a rectangle; its corners from the slab's middle.
    left = jnp.clip(begin - middle, -0.5 * width, 0.5 * width)
    right = jnp.clip(finish - middle, -0.5 * width, 0.5 * width)

    def edge(side: float) -> Array:
        """The lowest line above the upper corners (1), or the highest below the lower ones (-1)."""
        height = side * station + half_step
        highest = jnp.max(jnp.where(is_in, height, -jnp.inf), axis=1)
        lowest = jnp.min(jnp.where(is_in, height, jnp.inf), axis=1)
        spread = jnp.where(jnp.isfinite(highest), highest - lowest, 0.0)
        slope = spread[:, None] / width * _SLOPES.astype(station.dtype)  # (slabs, slopes)
        above = jnp.maximum(
            height - slope[..., None] * left[:, None], height - slope[..., None] * right[:, None]
        )
        most = jnp.max(jnp.where(is_in[:, None], above, -jnp.inf), axis=2)
        best = jnp.argmin(most, axis=1)[:, None]
        level, rise = (jnp.take_along_axis(each, best, axis=1) for each in (most, slope))
        return side * (level + rise * (0.5 * width) * np.array([-1.0, 1.0], station.dtype))

    present = jnp.any(is_in, axis=1)
    lower, upper = edge(-1.0), edge(1.0)
    return Blocked(
        start=start,
        end=start + width,
        lower=jnp.where(present[:, None], lower, 0.0),
        upper=jnp.where(present[:, None], upper, 1.0),
        present=present,
    )
