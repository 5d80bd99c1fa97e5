"""Paths of a car's rear axle without a speed, and the fit of a drivable path to given points."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.optimise.levenberg import LevenbergConfig, Model, least_squares
from planner_jax.robot.car_motion import Quadratic, by_unknowns, motion

_HIGHEST = lax.Precision.HIGHEST


@struct.dataclass
class Path:
    """N equally spaced points of a path, or a batch of paths with leading axes.

    Between two points the curvature is linear in the station, the distance along the path.
    """

    pos: Array  # (N, 2) [m], of the rear axle's middle
    heading: Array  # (N,) [rad]
    curvature: Array  # (N,) [1/m]
    length: Array  # () [m]

    def curvature_at(self, station: Array) -> Array:
        """Return the curvature (M,) [1/m] at M stations [m] along one path.

        Before the start and after the end the curvature is constant.
        """
        stations = jnp.linspace(0.0, 1.0, self.curvature.shape[-1]) * self.length
        return jnp.interp(station, stations, self.curvature)


def path_along(start: Array, length: Array, curvature: Array) -> Path:
    """Return the path of a length [m] from a pose (3,), with curvatures (N,) [1/m] at N points."""
    drive = motion(start, length, jnp.ones_like(curvature), curvature, 1)
    return Path(
        pos=jnp.concatenate([start[None, :2], drive.pos[:, 0]]),
        heading=jnp.concatenate([start[None, 2], drive.heading[:, 0]]),
        curvature=curvature,
        length=length,
    )


def path_of_drive(
    start: Array, time: Array, speed: Array, curvature: Array, num: int, samples: int = 8
) -> Path:
    """Return the path of a drive whose speed and curvature are linear in time between knots.

    Args:
        start: (3,) x, y [m], heading [rad].
        time: () [s], duration of the drive.
        speed: (K + 1,) [m/s], >= 0, at K + 1 equally spaced times (knots).
        curvature: (K + 1,) [1/m], at the knots.
        num: number of points of the path.
        samples: number of samples between two knots from which the path is interpolated.
    """
    knots = jnp.arange(speed.shape[0]) * samples
    fine = jnp.arange((speed.shape[0] - 1) * samples + 1)
    v, c = (jnp.interp(fine, knots, each) for each in (speed, curvature))
    step = time / (fine.shape[0] - 1)
    # Interpolation needs increasing stations (distances along the path): at standstill a step
    # counts as 1e-6 m.
    moved = jnp.maximum(0.5 * (v[1:] + v[:-1]) * step, 1e-6)
    station = jnp.concatenate([jnp.zeros_like(moved[:1]), jnp.cumsum(moved)])
    even = jnp.linspace(0.0, 1.0, num) * station[-1]
    return path_along(start, station[-1], jnp.interp(even, station, c))


@dataclasses.dataclass(frozen=True)
class FollowConfig:
    """Settings of the fit of a drivable path to given points."""

    stride: int = 2  # number of points from one knot of the curvature to the next
    miss: float = 0.01  # [m], distance from a point that adds 1 to the cost
    rate: float = 1.0  # weight of (change of curvature / limit) in the residuals
    slack: float = 0.02  # fraction of every limit that stays unused
    solver: LevenbergConfig = LevenbergConfig(30)


def path_beside(
    start: Array,
    curvature: Array,
    points: Array,
    curvatures: Array,
    length: Array,
    most: Array,
    rate: Array,
    config: FollowConfig = FollowConfig(),
) -> Path:
    """Return a path without curvature jumps that a car can drive along given points.

    Searched and smoothed paths consist of arcs, and start with a curvature that the car does not
    have. The returned path minimises the squared distance from the given points. Its curvature is
    linear between knots, and keeps its limits where the solver can satisfy them.

    Args:
        start: (3,) x, y [m] and heading [rad].
        curvature: () [1/m], at the start.
        points: (N, 2) [m], given points at equal distances, the first at the start. A knot is at
            every `config.stride`-th point, so N - 1 is a multiple of this number.
        curvatures: (N,) [1/m], curvature at the points, the initial guess.
        length: () [m], length of the path.
        most: () [1/m], limit of the curvature.
        rate: () [1/m^2], limit of the curvature's derivative along the path.
        config: settings of the fit.
    """
    num = (points.shape[0] - 1) // config.stride
    identity = jnp.eye(num, dtype=points.dtype)
    change = (identity - jnp.eye(num, k=-1, dtype=points.dtype)) * num
    limits = most * (1.0 - config.slack), rate * (1.0 - config.slack)

    def knots_of(unknown: Array) -> Array:
        return jnp.concatenate([curvature[None], unknown])

    def evaluate(unknown: Array) -> Model:
        knots = knots_of(unknown)
        drive = motion(start, length, jnp.ones_like(knots), knots, config.stride)
        away = (drive.pos - points[1:].reshape(drive.pos.shape)) / config.miss**2
        rates = (knots[1:] - knots[:-1]) * (num / length)
        pull, stiffness = by_unknowns(drive, nearness(away, config.miss), is_time_free=False)
        values, rows = [], []
        each = ((unknown, identity, limits[0]), (rates, change / length, limits[1]))
        for value, row, limit in each:
            over = jnp.maximum(jnp.abs(value) / limit - 1.0, 0.0)
            sign = jnp.where(over > 0.0, jnp.sign(value), 0.0) / limit
            values.append(100.0 * over)
            rows.append(100.0 * sign[:, None] * row)
        values.append(config.rate * rates / limits[1])
        rows.append(config.rate * change / (length * limits[1]))
        residuals, jacobian = jnp.concatenate(values), jnp.concatenate(rows)
        excess = jnp.maximum(jnp.max(jnp.abs(unknown)) / most, jnp.max(jnp.abs(rates)) / rate)
        return Model(
            cost=jnp.sum(residuals**2) + jnp.sum((away * config.miss) ** 2),
            gradient=jnp.matmul(jacobian.T, residuals, precision=_HIGHEST) + pull[num:],
            curvature=jnp.matmul(jacobian.T, jacobian, precision=_HIGHEST) + stiffness[num:, num:],
            violation=excess - 1.0,
        )

    guess = jnp.clip(curvatures[config.stride :: config.stride], -most, most)
    knots = knots_of(least_squares(evaluate, guess, config.solver).point)
    positions = jnp.arange(points.shape[0]) / config.stride
    return path_along(start, length, jnp.interp(positions, jnp.arange(num + 1), knots))


def nearness(push: Array, miss: float) -> Quadratic:
    """Return the quadratic model of the cost |x - p|^2 / miss^2 of samples x near given points p.

    `push` (K, S, 2) [1/m] is (x - p) / miss^2, half of the cost's gradient, for S samples in each
    of K pieces of a path. A sample at the distance `miss` [m] from its point costs 1.
    """
    num, samples, _ = push.shape
    stiffness = jnp.zeros((4, 4), push.dtype).at[jnp.arange(2), jnp.arange(2)].set(miss**-2)
    return Quadratic(
        push=jnp.pad(push, ((0, 0), (0, 0), (0, 2))),
        stiffness=jnp.broadcast_to(stiffness, (num, samples, 4, 4)),
        piece_push=jnp.zeros((num, 5), push.dtype),
        piece_stiffness=jnp.zeros((num, 5, 5), push.dtype),
    )
