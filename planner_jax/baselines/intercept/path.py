"""A way of the rear axle, without a speed: the first half of a plan that splits both."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.optimise.levenberg import LevenbergConfig, Model, least_squares
from planner_jax.task.intercept.motion import Quadratic, by_unknowns, motion

_HIGHEST = lax.Precision.HIGHEST


@struct.dataclass
class Path:
    """N equally spaced points of a way, or a batch with leading axes; stations count from 0.

    Between two points the curvature changes evenly along the way.
    """

    pos: Array  # (N, 2) [m], of the rear axle's middle
    heading: Array  # (N,) [rad]
    curvature: Array  # (N,) [1/m]
    length: Array  # () [m]

    def curvature_at(self, station: Array) -> Array:
        """Curvature [1/m] of one way at stations (M,) [m]; held at its ends."""
        stations = jnp.linspace(0.0, 1.0, self.curvature.shape[-1]) * self.length
        return jnp.interp(station, stations, self.curvature)


def path_along(start: Array, length: Array, curvature: Array) -> Path:
    """The path from a pose (3,) with curvatures (N,) [1/m] at equal distances."""
    way = motion(start, length, jnp.ones_like(curvature), curvature, 1)
    return Path(
        pos=jnp.concatenate([start[None, :2], way.pos[:, 0]]),
        heading=jnp.concatenate([start[None, 2], way.heading[:, 0]]),
        curvature=curvature,
        length=length,
    )


def path_of_drive(
    start: Array, time: Array, speed: Array, curvature: Array, num: int, samples: int = 8
) -> Path:
    """The way of a drive whose speed and curvature change evenly between equal knots.

    Args:
        start: (3,) x, y [m], heading [rad].
        time: () [s], the end.
        speed: (K + 1,) [m/s], at the knots, nowhere negative.
        curvature: (K + 1,) [1/m].
        num: N, points of the path.
        samples: of every piece, between which the curvature is interpolated by the station.
    """
    knots = jnp.arange(speed.shape[0]) * samples
    fine = jnp.arange((speed.shape[0] - 1) * samples + 1)
    v, c = (jnp.interp(fine, knots, each) for each in (speed, curvature))
    step = time / (fine.shape[0] - 1)
    # Where the car stands the station has to grow a little, to be interpolated by.
    moved = jnp.maximum(0.5 * (v[1:] + v[:-1]) * step, 1e-6)
    station = jnp.concatenate([jnp.zeros_like(moved[:1]), jnp.cumsum(moved)])
    even = jnp.linspace(0.0, 1.0, num) * station[-1]
    return path_along(start, station[-1], jnp.interp(even, station, c))


@dataclasses.dataclass(frozen=True)
class FollowConfig:
    """How a car follows given points; static."""

    stride: int = 2  # every how many points the curvature has a knot
    miss: float = 0.01  # [m], away from a point counts as much as
    rate: float = 1.0  # ... such a share of the greatest rate of the curvature
    slack: float = 0.02  # share of every limit that is kept free
    solver: LevenbergConfig = LevenbergConfig(30)


def path_beside(
    start: Array,
    curvature: Array,
    points: Array,
    bends: Array,
    length: Array,
    most: Array,
    rate: Array,
    config: FollowConfig = FollowConfig(),
) -> Path:
    """A path that a car can drive along given points: its curvature does not jump.

    Searched and smoothed paths begin with a curvature that the car does not have, and consist of
    arcs. This is the path nearest to their points by least squares among those whose curvature
    changes evenly between knots and keeps its limits, as far as that goes.

    Args:
        start: (3,) x, y [m] and heading [rad].
        curvature: () [1/m], at the start.
        points: (N, 2) [m], at equal distances, the first one the start's; N - 1 is a multiple of
            the stride.
        bends: (N,) [1/m], curvature there, as a first guess.
        length: () [m], of the path.
        most: () [1/m], the greatest curvature.
        rate: () [1/m^2], the greatest change of curvature by the way.
        config: weights and sizes.
    """
    num = (points.shape[0] - 1) // config.stride
    own = jnp.eye(num, dtype=points.dtype)
    change = (own - jnp.eye(num, k=-1, dtype=points.dtype)) * num
    limits = most * (1.0 - config.slack), rate * (1.0 - config.slack)

    def at(unknown: Array) -> Array:
        return jnp.concatenate([curvature[None], unknown])

    def evaluate(unknown: Array) -> Model:
        knots = at(unknown)
        way = motion(start, length, jnp.ones_like(knots), knots, config.stride)
        away = (way.pos - points[1:].reshape(way.pos.shape)) / config.miss**2
        rates = (knots[1:] - knots[:-1]) * (num / length)
        pull, stiffness = by_unknowns(way, nearness(away, config.miss), is_time_free=False)
        values, rows = [], []
        each = ((unknown, own, limits[0]), (rates, change / length, limits[1]))
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

    guess = jnp.clip(bends[config.stride :: config.stride], -most, most)
    knots = at(least_squares(evaluate, guess, config.solver).point)
    places = jnp.arange(points.shape[0]) / config.stride
    return path_along(start, length, jnp.interp(places, jnp.arange(num + 1), knots))


def nearness(push: Array, miss: float) -> Quadratic:
    """The squared distance of samples (K, S) from places, as half its gradient (K, S, 2) is."""
    num, samples, _ = push.shape
    stiffness = jnp.zeros((4, 4), push.dtype).at[jnp.arange(2), jnp.arange(2)].set(miss**-2)
    return Quadratic(
        push=jnp.pad(push, ((0, 0), (0, 0), (0, 2))),
        stiffness=jnp.broadcast_to(stiffness, (num, samples, 4, 4)),
        piece_push=jnp.zeros((num, 5), push.dtype),
        piece_stiffness=jnp.zeros((num, 5, 5), push.dtype),
    )
