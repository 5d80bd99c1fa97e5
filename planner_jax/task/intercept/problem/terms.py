"""Terms of an interception's cost, with derivatives: weighted squares of residuals.

The residuals are the distance from the target at the end, the acceleration, and hinges: one-sided
penalties max(excess, 0) on limits and on distances from obstacles.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.plane.distance_field import DistanceField
from planner_jax.plane.obstacles import distances, place
from planner_jax.robot.car_motion import V_RIGHT, Motion
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.problem.clearance import discs_of, nearest_in_region, wrap

_HIGHEST = lax.Precision.HIGHEST
_NARROW = 0.03  # width of an interval of end speeds that is reduced to its middle


@struct.dataclass
class Weights:
    """Weights of the squared residuals, and the thresholds of hinges (one-sided penalties)."""

    miss: float = 300.0  # [1/m^2], of the distance from the target at the end
    obstacle: float = 1e3  # [1/m^2], of the distance by which a body comes too close to an obstacle
    limit: float = 1e3  # of the relative excess of a value over its limit
    effort: float = 0.064  # [s^3/m^2], of the discomfort
    early: float = 300.0  # of the meeting time divided by `HORIZON`, if the time is free
    follow: float = 0.0  # [1/m^2], of the distance at knots from a path of cells
    margin: float = 0.03  # [m], distance from obstacles below which they are penalised
    slack: float = 0.015  # a value is penalised above (1 - slack) times its limit
    is_time_fixed: bool = False  # whether the meeting time stays as it is, even if it is free


# Time to which a free meeting time is related, and tolerance of the distance from the target for
# which the weights are chosen, in the units of `units.enter_units`. They do not depend on the case:
# if the time limit is twice as long, the balance of penalties and meeting time is the same.
HORIZON, TOLERANCE = 16.0, 0.05

# Factors of the discomfort, in the units of `units.enter_units`: of the lateral jerk, a time; and
# of the steering angle's rate, an acceleration times a time.
JERK = 0.5
STEERING = 0.5


def limit_terms(
    case: InterceptCase, time: Array, speed: Array, curvature: Array, weights: Weights, points: int
) -> tuple[Array, Array, Array]:
    """Compute the penalties on the car's limits and the discomfort, for a motion of K pieces.

    The discomfort is the integral over time of  a^2 + a_n^2 + (JERK j_n)^2 + (STEERING w)^2.  Here
    a is the acceleration along the path, a_n the lateral acceleration v^2 kappa, j_n its time
    derivative, and w the rate of the steering angle.

    `points` is the number of points of a piece at which the lateral acceleration is checked.

    Returns:
        squares: (K, 6, 6), for every piece the sum of w g g^T over its residuals r with weights w.
            The vector g holds the derivatives of r by five variables, and last r itself: speed at
            the piece's start and end, curvature there, and the end time of the motion.
        violation: (), largest relative excess over a limit, and excess over the bounds of the
            speed at the end.
        discomfort: () [m^2/s^3], the integral above.
    """
    limits, dtype = case.limits, speed.dtype
    rate = (speed.shape[0] - 1) / time
    v, c = speed[None, 1:], curvature[None, 1:]
    v0, c0 = speed[None, :-1], curvature[None, :-1]
    acceleration, bending = (v - v0) * rate, (c - c0) * rate
    # For a given rate of curvature the steering angle changes fastest where |curvature| is least.
    flat = jnp.where(c * c0 > 0.0, jnp.minimum(c**2, c0**2), 0.0)
    gain = case.body.wheelbase / (1.0 + case.body.wheelbase**2 * flat)
    steering = gain * bending
    share = jnp.asarray((np.arange(points) + 1.0) / points, dtype)[:, None]
    fast, bend = share * v + (1.0 - share) * v0, share * c + (1.0 - share) * c0
    by_speed, by_curvature = 2.0 * fast * bend, fast**2
    # Limited values: speed, curvature, acceleration, steering rate, and the lateral acceleration at
    # `points` positions. The limits v_min <= v <= v_max are written as |v - middle| <= half, where
    # half is (v_max - v_min) / 2.
    middle, half = (
        0.5 * (limits.speed + limits.least_speed),
        0.5 * (limits.speed - limits.least_speed),
    )
    values = jnp.concatenate([v - middle, c, acceleration, steering, by_curvature * bend])
    lateral = jnp.full(points, limits.lateral_acceleration)
    others = [half, limits.curvature, limits.acceleration, limits.steering_rate]
    bounds = jnp.concatenate([jnp.stack(others), lateral])[:, None]
    none, rates = jnp.zeros_like(v), jnp.full_like(v, rate)
    slopes = jnp.stack(  # derivatives of the values by the five variables of a piece, (5, R, K)
        [
            jnp.concatenate([none, none, -rates, none, (1.0 - share) * by_speed]),
            jnp.concatenate([none + 1.0, none, rates, none, share * by_speed]),
            jnp.concatenate([none, none, none, -gain * rate, (1.0 - share) * by_curvature]),
            jnp.concatenate([none, none + 1.0, none, gain * rate, share * by_curvature]),
            jnp.concatenate(
                [none, none, -acceleration / time, -steering / time, jnp.zeros_like(fast)]
            ),
        ]
    )
    excess = jnp.abs(values) / bounds - 1.0
    inside = jnp.maximum(excess + weights.slack, 0.0)
    sign = jnp.where(inside > 0.0, jnp.sign(values), 0.0) / bounds
    hinges = jnp.concatenate([sign[None] * slopes, inside[None]])
    squares = _sum_squares(hinges, weights.limit)
    # The speed at the end has bounds of its own, in units of speed.
    low, high = case.end_speed[0], case.end_speed[1]
    over, under = v[0, -1] - high, low - v[0, -1]
    is_held, _ = held_end_speed(case)
    is_over, is_under = (~is_held & (each + weights.slack > 0.0) for each in (over, under))
    is_under &= low > limits.least_speed
    at_end = jnp.where(is_over, over + weights.slack, 0.0)
    at_end -= jnp.where(is_under, under + weights.slack, 0.0)
    slope_at_end = jnp.where(is_over, 1.0, 0.0) + jnp.where(is_under, 1.0, 0.0)
    end = jnp.zeros((6, 1), dtype).at[V_RIGHT].set(slope_at_end).at[5].set(at_end)
    squares = squares.at[..., -1].add(_sum_squares(end, weights.limit))
    wrong_end = jnp.maximum(over, jnp.where(low > limits.least_speed, under, -1.0))
    # Residuals of the discomfort, whose integral over a piece is a square times the duration.
    sideways, sideways0 = v**2 * c, v0**2 * c0
    rough = jnp.concatenate(
        [acceleration, sideways, JERK * (sideways - sideways0) * rate, STEERING * steering]
    )
    by_jerk, by_steering = JERK * rate, STEERING * gain * rate
    of_duration = jnp.asarray([-0.5, 0.5, -0.5, -0.5], dtype)[:, None] / time
    smooth = jnp.stack(
        [
            jnp.concatenate([-rates, none, -2.0 * by_jerk * v0 * c0, none]),
            jnp.concatenate([rates, 2.0 * v * c, 2.0 * by_jerk * v * c, none]),
            jnp.concatenate([none, none, -by_jerk * v0**2, -by_steering]),
            jnp.concatenate([none, v**2, by_jerk * v**2, by_steering]),
            of_duration * rough,
            rough,
        ]
    )
    squares += _sum_squares(smooth, weights.effort / rate)
    discomfort = jnp.sum(rough**2) / rate
    squares, worst = jnp.moveaxis(squares, -1, 0), jnp.maximum(jnp.max(excess), wrong_end)
    if limits.jerk is not None:
        worst = jnp.maximum(worst, jnp.max(jerk_excess(limits.jerk, time, speed)))
    return squares, worst, discomfort


def held_end_speed(case: InterceptCase) -> tuple[Array, Array]:
    """Return whether the speed at the end is prescribed, () bool, and this speed () [m/s].

    It is prescribed if its bounds leave no interval in which both of their penalties are zero. The
    speed is then the middle of the interval, so that no penalty competes with the meeting time.
    """
    limits = case.limits
    low = jnp.clip(case.end_speed[0], limits.least_speed, limits.speed)
    high = jnp.clip(case.end_speed[1], limits.least_speed, limits.speed)
    return high - low < _NARROW, 0.5 * (low + high)


def jerk_excess(limit: Array, time: Array, speed: Array) -> Array:
    """Return relative excesses (K - 1,) of the jerk at the knots 1 to K - 1 over its limit.

    The speeds (K + 1,) belong to equally spaced knots from time 0 to `time` (), at which the
    acceleration changes. The jerk is this change divided by the time between two knots.
    """
    rate = (speed.shape[0] - 1) / time
    return jnp.abs(speed[2:] - 2.0 * speed[1:-1] + speed[:-2]) * rate**2 / limit - 1.0


def _sum_squares(rows: Array, weight: Array | float) -> Array:
    return jnp.sum((weight * rows)[:, None] * rows[None], axis=2)


class SumOfSquares:
    """Accumulator of the matrix sum of w g g^T over residuals r with weights w.

    The vector g holds the derivatives of r, and last r itself. Only its entries that may differ
    from zero are passed and multiplied.
    """

    def __init__(self, size: int, sums: Mapping[tuple[int, int], Array] | None = None):
        """Start from entries `sums[a, b]`, a <= b, of a matrix (size, size), by default zeros."""
        self._size = size
        self._sums: dict[tuple[int, int], Array | float] = dict(sums or {})

    def add(self, row: Mapping[int, Array | float], weight: Array | float = 1.0) -> None:
        """Add w g g^T of one residual; `row` maps an index of g to the entry of g there."""
        for a, left in row.items():
            for b, right in row.items():
                if a <= b:
                    self._sums[a, b] = self._sums.get((a, b), 0.0) + weight * (left * right)

    def matrix(self, like: Array) -> Array:
        """Return the sums as matrices (..., size, size) for residuals of the shape (...).

        `like` is an array of this shape; entries that are constants are repeated to fill it.
        """
        indices = range(self._size)
        sums = [
            jnp.broadcast_to(self._sums.get((min(a, b), max(a, b)), 0.0), like.shape)
            for a in indices
            for b in indices
        ]
        stacked = jnp.stack(sums).astype(like.dtype)
        return jnp.moveaxis(stacked.reshape(self._size, self._size, *like.shape), (0, 1), (-2, -1))


def meeting_terms(
    case: InterceptCase, drive: Motion, time: Array, weights: Weights
) -> tuple[Array, Array]:
    """Compute the residuals of the meeting: distance from the target, and error of the heading.

    Returns:
        squares: (5, 5), the sum of w g g^T over the residuals r with weights w. The vector g holds
            the derivatives of r by x, y, heading and time of the last sample, and last r itself.
            The distance is measured from the region around the target.
        violation: (), largest relative excess over the tolerances of distance and heading.
    """
    pos, heading, direction = drive.pos[-1, -1], drive.heading[-1, -1], drive.direction[-1, -1]
    target = case.target.at(time)
    aside = jnp.stack([-direction[1], direction[0]])
    offset = pos + case.body.middle * direction - target.pos
    miss, slope = nearest_in_region(case.region, offset)
    off = wrap(heading - case.end_heading)
    turned = jnp.abs(off) / case.heading_tolerance - 1.0
    over = jnp.where(case.heading_tolerance < np.pi, jnp.maximum(turned + 0.1, 0.0), 0.0)
    sign = jnp.where(over > 0.0, jnp.sign(off), 0.0) / case.heading_tolerance
    columns = [jnp.eye(2), case.body.middle * aside[:, None], -target.vel[:, None]]
    moved = jnp.matmul(slope, jnp.concatenate(columns, axis=1), precision=_HIGHEST)
    rows = jnp.concatenate([moved, miss[:, None]], axis=1)
    none = jnp.zeros_like(sign)
    turn = jnp.stack([none, none, sign, none, over])
    squares = (
        weights.miss * jnp.matmul(rows.T, rows, precision=_HIGHEST) + turn[:, None] * turn[None]
    )
    missed = jnp.sqrt(jnp.sum(miss**2) + 1e-12) / case.tolerance - 1.0
    return squares, jnp.maximum(missed, turned)


def following_terms(drive: Motion, positions: Array, weights: Weights) -> Array:
    """Compute the penalty on distances of the K pieces' ends from positions (K, 2) [m].

    The result (K, 5, 5) is the sum of w g g^T over the residuals r with weights w of each end. The
    vector g holds the derivatives of r by the end's x, y, heading and time, and last r itself.
    """
    x, y = (drive.pos[:, -1] - positions).T
    squares = SumOfSquares(5)
    squares.add({0: 1.0, 4: x}, weights.follow)
    squares.add({1: 1.0, 4: y}, weights.follow)
    return squares.matrix(x)


def obstacle_terms(
    case: InterceptCase, field: DistanceField, drive: Motion, weights: Weights, discs: int
) -> tuple[Array, Array]:
    """Compute the penalties on the distances of the body from obstacles and from the map's edge.

    The body is covered by `discs` discs. The fewer discs, the further they extend beyond its sides.

    Returns:
        squares: (K, S, 5, 5), for S samples on K pieces the sum of w g g^T over the residuals r
            with weights w. The vector g holds the derivatives of r by the sample's x, y, heading
            and time, and last r itself.
        close: (), largest penetration of an obstacle by a disc, or excess of the body's middle
            beyond the map, divided by the body's width.
    """
    radius, ahead = discs_of(case.body, discs)
    shape = drive.heading.shape
    x, y = (drive.pos[..., k].reshape(-1) for k in range(2))  # (M,)
    cos, sin = (drive.direction[..., k].reshape(-1) for k in range(2))
    weight = weights.obstacle * (100.0 / x.size)
    movers = place(case.movers, drive.time.reshape(-1))

    def measure(offset: Array) -> tuple[Array, ...]:
        at_x, at_y = x + offset * cos, y + offset * sin
        still, still_x, still_y = (each[None] for each in field.near(at_x, at_y))
        local = movers.enter(at_x[None], at_y[None])
        far, away = distances(case.movers.corners, movers.present, *local)
        away_x, away_y = movers.leave(*away)
        speed_x, speed_y = movers.velocity
        passing = -(away_x * speed_x + away_y * speed_y)
        if movers.turn is not None:  # a turning obstacle moves the nearest point of its edge
            to_x, to_y = at_x[None] - movers.x, at_y[None] - movers.y
            passing -= movers.turn[2] * (away_y * to_x - away_x * to_y)
        return (
            jnp.concatenate([still, far - movers.radius]),
            jnp.concatenate([still_x, away_x]),
            jnp.concatenate([still_y, away_y]),
            jnp.concatenate([jnp.zeros_like(still), passing - case.movers.growth[:, None]]),
        )

    # Without the loop `lax.map`, XLA would compute the obstacles' distances anew for every use.
    far, away_x, away_y, passing = lax.map(measure, ahead)  # (discs, 1 + N, M)
    wanted = radius + case.margin
    inside = jnp.maximum(wanted + weights.margin - far, 0.0)
    is_inside = inside > 0.0
    turn = ahead[:, None, None] * (away_y * cos[None, None] - away_x * sin[None, None])
    slopes = [jnp.where(is_inside, -each, 0.0) for each in (away_x, away_y, turn, passing)]
    rows = [*slopes, inside]
    squares = SumOfSquares(
        5, {(a, b): jnp.sum(rows[a] * rows[b], axis=(0, 1)) for a in range(5) for b in range(a, 5)}
    )
    middle = case.body.middle
    off_map = []
    for axis, (across, along) in enumerate(_map_axes(case)):
        at = (x + middle * cos) * across + (y + middle * sin) * along
        slope = middle * (cos * along - sin * across)
        above, below = at - case.upper[axis], case.lower[axis] - at
        off_map += [above, below]
        over, under = (jnp.maximum(each + weights.margin, 0.0) for each in (above, below))
        beyond = over - under
        is_beyond = jnp.where(beyond != 0.0, 1.0, 0.0)
        squares.add({0: across * is_beyond, 1: along * is_beyond, 2: slope * is_beyond, 4: beyond})
    close = jnp.maximum(jnp.max(wanted - far), jnp.max(jnp.stack(off_map)))
    return weight * squares.matrix(x).reshape(*shape, 5, 5), close / case.body.width


def _map_axes(case: InterceptCase) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return the directions (x, y) of the map's two axes."""
    cos, sin = jnp.cos(case.map_heading), jnp.sin(case.map_heading)
    return (cos, sin), (-sin, cos)
