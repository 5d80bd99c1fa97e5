"""Estimate of a ball's flight from one's own recording, and its prediction with uncertainty.

The unknowns are position and velocity at the first observation, logarithm of the drag K_D, lift
vector l, share a and drift of delays of the stamps, restitution and friction of the plane, and log
`Ball.reach`. For a periodic camera, deviations of its stamps from the period are delays: a is 1. If
times are irregular, a is 0. Gauss-Newton steps find the most probable values. Errors of positions
have Student's t distribution: outliers have small weights. Errors along the path exceed errors
across it by the error of a time stamp, multiplied by the speed. The residuals yield both standard
deviations and the correlation of neighbouring errors.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from planner_jax.ball.spin import SpinningBall, Surroundings, spin_acceleration, spin_flight
from planner_jax.core import GRAVITY
from planner_jax.core.arithmetic import at_least
from planner_jax.core.checks import require_number, shape_of
from planner_jax.core.choices import require, require_one_of
from planner_jax.core.compiled import QUICK_OPTIONS
from planner_jax.core.errors import CaseError
from planner_jax.core.rules import POSITIVE

_UNKNOWNS, _BEFORE = 15, 12  # numbers of unknowns, and of those with an effect before a bounce
_DRIFT = 4.0  # standard deviation of the drift of stamps, divided by the spread of their delays
_TAIL = 4.0  # degrees of freedom of Student's t distribution of the errors
_WEIGHT = 4.0  # number of observations that the assumed noise counts for
_ROUNDS = (2, 4)  # numbers of linearisations of a short flight without bounce, and of others
_WEIGHINGS = 3  # number of weighted least-squares problems for each linearisation
_LEAST = 4  # least number of observations
_BOUNCES = 2  # number of bounces that are simulated
# Each row selects a pair of observations, from which a first guess of the flight is made. A row has
# the time of the first observation, and the time from there to the second one, as fractions of the
# recording's duration. The fractions are quasi-random numbers.
_PAIRS = 0.6 * (np.arange(1, 17)[:, None] * [0.618034, 0.754878] % 1.0)
# Numbers of Runge-Kutta steps of a flight, and greatest products of drag and distance for them.
_STEPS = ((2, 0.25), (4, 1.0), (12, math.inf))
_FAR = 25.0  # squared distance, in standard deviations, from which an observation is an outlier
_MOST_OUTLIERS = 0.45  # greatest share of outliers of a recording
_MOST_NOISE = 0.1  # greatest error of an observation along the path, as a share of its extent
_MOST_LIFT = 8.0  # greatest length of the lift vector, in standard deviations


@dataclass(frozen=True)
class Ball:
    """Properties of a ball, and of the plane on which it bounces, as known before its flight.

    The default is an unknown ball. `spin_bounce` states the model of a bounce.
    """

    drag: float = 0.06  # [1/m], median of K_D
    drag_spread: float = 1.0  # standard deviation of log K_D
    # Standard deviations of the lift vector, in units of K_D |v|: along the flight, horizontal
    # and across the flight (topspin, backspin), and perpendicular to both (sidespin).
    lift_spread: tuple[float, float, float] = (0.4, 0.4, 0.4)
    reach: tuple[float, float] = (20.0, 0.3)  # [m], speed of the surface / |l|, and spread of log
    restitution: tuple[float, float] = (0.8, 0.1)  # e, mean and standard deviation
    friction: tuple[float, float] = (0.3, 0.1)  # mu, mean and standard deviation
    grip: float = 0.4  # 2/5 for a hollow ball, 2/7 for a solid ball
    density: float = 0.01  # [m^2/s^3], power spectral density of accelerations not in the model

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            for each in np.atleast_1d(value):
                require_number(name, float(each), POSITIVE)

    @classmethod
    def sphere(cls, mass: float, diameter: float, *, air: float = 1.2) -> Self:
        """Describe a smooth sphere by its mass [kg] and diameter [m]; `air` is in kg/m^3.

        The drag coefficient C_d is 0.47, with a standard deviation of 20 %. The lift coefficient is
        0.4 r omega / |v|.
        """
        for name, value in (("mass", mass), ("diameter", diameter), ("air", air)):
            require_number(name, value, POSITIVE)
        unit = air * math.pi * diameter**2 / (8.0 * mass)  # [1/m]
        return cls(drag=0.47 * unit, drag_spread=0.2, reach=(1.0 / (0.4 * unit), 0.3))


# Drag, spin and bounces of "table tennis" were measured on recordings of two laboratories.
_TABLE_TENNIS = Ball(0.133, 0.1, (0.6, 0.35, 0.22), (8.0, 0.4), (0.94, 0.05), (0.24, 0.05))
BALLS = {"unknown": Ball(), "table tennis": _TABLE_TENNIS}


@dataclass(frozen=True)
class Prediction:
    """Positions and velocities of a ball at T times, or at (B, T) times of B balls."""

    pos: np.ndarray  # (T, 3) [m]
    vel: np.ndarray  # (T, 3) [m/s]
    covariance: np.ndarray  # (T, 3, 3) [m^2], of the true position
    observed_covariance: np.ndarray  # (T, 3, 3) [m^2], of an observed position
    freedom: np.ndarray  # (T,), degrees of freedom of Student's t distribution of the errors

    def interval(
        self, probability: float = 0.9, *, observed: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds (T, 3) [m] between which each coordinate is with the probability.

        With `observed`, the bounds are for an observed position, which has noise.
        """
        require(0.0 < probability < 1.0, "probability", "> 0 and < 1", probability)
        covariance = self.observed_covariance if observed else self.covariance
        half = np.sqrt(np.einsum("...ii->...i", covariance))
        half = half * stdtrit(self.freedom, 0.5 + 0.5 * probability)[..., None]
        return self.pos - half, self.pos + half


@dataclass(frozen=True)
class FlightFit:
    """Estimated flight of one ball, or of B balls, whose arrays have a leading axis (B,)."""

    start: np.ndarray  # () [s], time of the first observation
    pos: np.ndarray  # (3,) [m], position at that time
    vel: np.ndarray  # (3,) [m/s], velocity at that time
    drag: np.ndarray  # () K_D [1/m]
    lift: np.ndarray  # (3,) [1/s], lift vector l before the first bounce
    noise: np.ndarray  # () [m], standard deviation of an observed coordinate across the path
    stamp_noise: np.ndarray  # () [s], standard deviation of a time stamp
    outliers: np.ndarray  # () share of observations that are far from the flight
    covariance: np.ndarray  # (15, 15), of the unknowns, in the order of the module's docstring
    _data: tuple[Any, ...]  # times of observations, origin, and inputs of the program of `predict`

    def predict(self, times: ArrayLike) -> Prediction:
        """Predict the ball at times (T,), or (B, T) for a batch, on the recording's clock [s].

        Raises:
            ArgumentError: a time is before the first observation, or the shape is another one.
        """
        shape, batch = shape_of("times", times), self.start.shape
        fits = 0 not in shape and len(shape) in {1, 1 + len(batch)}
        require(fits, "times", "of the shape (T,) or (B, T)", shape)
        times = np.broadcast_to(np.asarray(times, np.float64), (*batch, shape[-1]))
        after = times - self.start[..., None]
        require(bool(np.all(after >= 0.0)), "times", "at or after the first one", shown="another")
        return self._predict(after)

    def smooth(self) -> Prediction:
        """Return the ball at the times of the observations; absent times are the first one."""
        return self._predict(np.nan_to_num(self._data[0] - self.start[..., None]))

    def _predict(self, after: np.ndarray) -> Prediction:
        _, origin, freedom, fitted, numbers, bounces = self._data
        rows, num = after.reshape(-1, after.shape[-1]), after.shape[-1]
        lanes = np.minimum(np.arange(len(fitted)), len(rows) - 1)
        padded = rows[lanes][:, np.minimum(np.arange(_next_size(num)), num - 1)]
        distance = float(after.max() * np.abs(self.vel).max())
        program = _program(_forecast, bounces, _num_steps(numbers[0] * distance))
        found = np.asarray(program(fitted, padded.astype(np.float32), numbers), np.float64)
        found = found[: len(rows), :num].reshape((*after.shape, 24))
        sure, seen = (found[..., k : k + 9].reshape((*after.shape, 3, 3)) for k in (6, 15))
        freedom = freedom[..., None] + np.zeros(after.shape)
        pos = found[..., :3] + origin[..., None, :]
        return Prediction(pos, found[..., 3:6], sure, seen, freedom)


def fit(
    times: ArrayLike,
    positions: ArrayLike,
    *,
    ball: Ball | str = "unknown",
    floor: float | None = None,
    gravity: float = GRAVITY,
    wind: ArrayLike = (0.0, 0.0, 0.0),
    noise: float = 0.002,
) -> FlightFit:
    """Estimate a ball's flight from observed positions: state, drag, lift, and their covariance.

    Outliers have little influence if more than half of the observations are good. Origin and first
    time are subtracted in double precision, so that times may be seconds of the epoch and positions
    UTM coordinates.

    Args:
        times: (N,) [s], or (B, N) for a batch of B recordings, increasing.
        positions: (N, 3) [m], or (B, N, 3), z up. An observation is absent if its time or its
            position is NaN or masked.
        ball: a `Ball`, or "table tennis" or "unknown".
        floor: [m], height of the ball's centre at its bounces, such as the height of a table plus
            the ball's radius; None if there is no plane. Two bounces are simulated.
        gravity: [m/s^2], magnitude.
        wind: (3,) [m/s], constant velocity of the air.
        noise: [m], expected standard deviation of a coordinate. It counts as four observations.

    Raises:
        ArgumentError: a shape does not match, or a number is out of range.
        CaseError: times do not increase, a recording has fewer than four observations, no single
            flight explains more than half of it, or its lift is far greater than `ball` allows.
    """
    if not isinstance(ball, Ball):
        require_one_of(BALLS, "ball", ball)
        ball = BALLS[ball]
    for name, value in (("gravity", gravity), ("noise", noise)):
        require_number(name, value, POSITIVE)
    times, positions = (
        np.ma.filled(each.astype(float), np.nan) if isinstance(each, np.ma.MaskedArray) else each
        for each in (times, positions)
    )
    shape = shape_of("positions", positions)
    is_shape = len(shape) in (2, 3) and shape[-1] == 3
    require(is_shape, "positions", "of the shape (N, 3) or (B, N, 3)", shape)
    for name, value, rule in (("times", times, shape[:-1]), ("wind", wind, (3,))):
        require(shape_of(name, value) == rule, name, f"of the shape {rule}", np.shape(value))
    batch, num = shape[:-2], shape[-2]
    clock = np.asarray(times, np.float64).reshape(-1, num)
    points = np.asarray(positions, np.float64).reshape(-1, num, 3)
    rows = np.concatenate([clock[..., None], points], axis=-1)
    present = np.asarray(np.isfinite(rows).all(axis=-1))
    counts = present.sum(axis=-1)
    _require(counts >= _LEAST, batch, "positions", "of at least 4 observations")
    if counts.min() < num:  # absent observations are the last ones
        order = np.argsort(~present, axis=-1, kind="stable")[..., None]
        rows = np.take_along_axis(np.where(present[..., None], rows, np.nan), order, axis=1)
    falls = rows[:, 1:, 0] <= rows[:, :-1, 0]
    _require(~falls.any(axis=-1), batch, "times", "strictly increasing")
    first, lanes = rows[:, 0].copy(), 1 if len(rows) == 1 else _next_size(len(rows), 64)
    padded = np.full((lanes, _next_size(num), 4), np.nan, np.float32)
    padded[: len(rows), :num] = rows - first[:, None]
    padded[len(rows) :] = padded[0]
    bounces, observed, floors = 0, 0, np.zeros(lanes, np.float32)
    if floor is not None:
        require_number("floor", floor)
        floors[: len(rows)] = floor - first[:, 3]
        low, high = np.nanmin(rows[..., 3], axis=-1), np.nanmax(rows[..., 3], axis=-1)
        bounces = _BOUNCES
        observed = _BOUNCES if np.any(low - floor < 0.5 * (high - low)) else 0
    numbers = _pack(ball, (float(gravity), *np.asarray(wind, np.float64).tolist(), float(noise)))
    distance = float(np.fmax.reduce(np.abs(padded[..., 1:]), axis=None))
    program = _program(_estimate, observed, _num_steps(ball.drag * distance))
    fitted = np.asarray(program(padded, floors, numbers))
    found = fitted[: len(rows)].reshape((*batch, -1)).astype(np.float64)
    state, covariance, others = _unpack(found)
    verdict, rule = others[..., 5], "of one flight in one frame, except for less than half"
    smooth = "of a flight with the lift and drag of `ball`; errors of neighbours are alike"
    _require(verdict >= 0.0, batch, "positions", smooth)
    _require(verdict > 0.0, batch, "positions", rule)
    start, origin = first[:, 0].reshape(batch), first[:, 1:].reshape((*batch, 3))
    freedom = (3.0 * counts - 9.0 + _WEIGHT).reshape(batch)
    pos, drag, errors = state[..., :3] + origin, np.exp(state[..., 6]), np.sqrt(others[..., :2])
    data = clock.reshape(shape[:-1]), origin, freedom, fitted, numbers, bounces
    beside = errors[..., 0], errors[..., 1], others[..., 4], covariance, data
    return FlightFit(start, pos, state[..., 3:6], drag, state[..., 7:10], *beside)


@functools.lru_cache
def _pack(ball: Ball, others: tuple[float, ...]) -> np.ndarray:
    packed = [float(x) for each in astuple(ball) for x in np.atleast_1d(each)]
    return np.array([*packed, *others], np.float32)


def _require(holds: np.ndarray | np.bool_, batch: tuple[int, ...], name: str, rule: str) -> None:
    if not holds.all():
        index = int(np.argmin(holds)) if batch else None
        raise CaseError(
            name, rule, index=index, shown="", more=int(np.size(holds) - np.sum(holds)) - 1
        )


def _unpack(fitted: Any) -> tuple[Any, Any, Any]:
    """Return the state, its covariance, and the other numbers of results of `_estimate`."""
    square = fitted[..., _UNKNOWNS:-6].reshape((*fitted.shape[:-1], _UNKNOWNS, _UNKNOWNS))
    return fitted[..., :_UNKNOWNS], square, fitted[..., -6:]


def _next_size(num: int, least: int = 16) -> int:
    return max(least, 1 << (num - 1).bit_length())


def _num_steps(exponent: float) -> int:
    return next(steps for steps, most in _STEPS if exponent <= most)


@functools.cache
def _program(function: Callable, bounces: int, steps: int) -> Callable:
    """Compile a function of one lane (recording) for a batch of lanes."""

    @functools.partial(jax.jit, compiler_options=QUICK_OPTIONS)
    @jax.default_matmul_precision("highest")
    def program(first: Array, second: Array, numbers: Array) -> Array:
        return jax.vmap(lambda a, b: function(a, b, numbers, (bounces, steps)))(first, second)

    return program


def _air(numbers: Array, floor: Array, state: Array) -> Surroundings:
    return Surroundings(
        numbers[13], numbers[14:17], floor, state[12], state[13], numbers[11], jnp.exp(state[14])
    )


def _positions(
    state: Array, stamps: Array, numbers: Array, floor: Array, counts: tuple[int, int]
) -> tuple[Array, tuple[Array, Array]]:
    """Return positions (N, 3), and positions with velocities as further results of `jacfwd`."""
    ball = SpinningBall(state[:3], state[3:6], jnp.exp(state[6]), state[7:10])
    air = _air(numbers, floor, state)
    pos, vel = spin_flight(ball, stamps[0], air, bounces=counts[0], steps=counts[1])
    pos = pos - (state[10] * (stamps[1] + state[11] * stamps[2]))[:, None] * vel
    return pos, (pos, vel)


def _linearise(num: int, state: Array, *others: Any) -> tuple[Array, tuple[Array, Array]]:
    """Return slopes (N, 3, num) by the first `num` unknowns, with positions and velocities."""
    whole = functools.partial(jnp.append, values=state[num:])
    return jax.jacfwd(lambda x: _positions(whole(x), *others), has_aux=True)(state[:num])


def _estimate(rows: Array, floor: Array, numbers: Array, counts: tuple[int, int]) -> Array:
    """Estimate one flight from rows (N, 4) of time [s] and position [m]; absent rows are NaN.

    The result has the unknowns, their covariance, squared errors of positions and of time
    stamps, last time, floor, share of outliers, and 1 if the flight explains the rows. Otherwise
    the last number is -1 if errors of neighbours are alike, and 0 if not.
    """
    present = jnp.isfinite(rows[:, 0])
    num = jnp.sum(present, dtype=rows.dtype)
    last = jnp.max(jnp.where(present, rows[:, 0], 0.0))
    times = jnp.where(present, rows[:, 0], last)
    seen = jnp.where(present[:, None], rows[:, 1:], 0.0)
    stamps, delay = _stamps(times, seen, present, num)
    others = stamps, numbers, floor, counts
    drag, spread, noise = numbers[0], numbers[1], numbers[17]
    is_short = counts[1] == _STEPS[0][0]
    free = _UNKNOWNS if counts[0] else _BEFORE
    later = [0.5, 0.0, numbers[7], numbers[9], jnp.log(numbers[5])]  # means of the last unknowns
    means = jnp.stack([jnp.log(drag), *jnp.zeros(3), *later])

    def guess(pair: Array) -> tuple[Array, ...]:
        i = jnp.floor(pair[0] * (num - 1.0))
        j = jnp.minimum(i + 1.0 + jnp.floor(pair[1] * num), num - 1.0).astype(jnp.int32)
        i = i.astype(jnp.int32)
        span = times[j] - times[i]
        # The mean velocity between two observations is the velocity in the middle of their times.
        air = _air(numbers, floor, jnp.zeros(_UNKNOWNS))
        ball = SpinningBall(seen[i], (seen[j] - seen[i]) / span, drag, jnp.zeros(3))
        acc = spin_acceleration(ball, air)
        vel = ball.vel - (0.5 * span + times[i]) * acc
        pos = ball.pos - times[i] * (vel + 0.5 * times[i] * acc)
        state = jnp.concatenate([pos, vel, means])
        if is_short and not counts[0]:  # a parabola is near enough to a short flight
            path = pos[None] + jnp.outer(times, vel) + jnp.outer(0.5 * times**2, acc)
        else:
            path = _positions(state, *others)[0]
        away = jnp.sum((path - seen) ** 2, axis=1)
        # A sum of roots depends little on outliers.
        return state, away, jnp.sum(jnp.where(present, jnp.sqrt(jnp.sqrt(away)), 0.0))

    states, away, misfits = jax.vmap(guess)(jnp.asarray(_PAIRS, rows.dtype))
    best = jnp.argmin(jnp.where(jnp.isfinite(misfits), misfits, jnp.inf))
    state, error = (
        states[best],
        jnp.sort(jnp.where(present, away[best], jnp.inf))[(0.5 * num).astype(jnp.int32)],
    )
    # Prior distribution of the unknowns after position and velocity. The lift vector has the axes
    # of `Ball.lift_spread`: forward, to the side, and perpendicular to both.
    speed = jnp.sqrt(at_least(jnp.sum(state[3:6] ** 2), 1e-6))
    forward = state[3:6] / speed
    side = jnp.stack([-forward[1], forward[0] + 1e-6, jnp.zeros_like(speed)])
    side = side / jnp.linalg.norm(side)
    frame = jnp.stack([forward, side, jnp.cross(forward, side)])
    spreads = numbers[2:5] * drag * speed
    # The lift along a short flight has no effect before a bounce: it is not estimated, and only its
    # uncertainty counts.
    scaled = frame / spreads.at[0].multiply(0.05 if is_short else 1.0)[:, None]
    later = [0.5, _DRIFT, numbers[8], numbers[10], numbers[6]]
    spread = jnp.stack([*jnp.full(6, jnp.inf), spread, *jnp.full(3, jnp.inf), *later])
    prior = jnp.diag(spread[:free] ** -2).at[7:10, 7:10].set(scaled.T @ scaled)

    def linearise(carry: tuple[Array, ...], _: None) -> tuple[tuple[Array, ...], tuple]:
        state, *weights = carry
        slopes, (pos, vel) = _linearise(free, state, *others)
        squared = at_least(jnp.sum(vel * vel, axis=1), 1e-6)
        direction = (vel * lax.rsqrt(squared)[:, None])[..., None]
        # Errors and their slopes in one array (N, 3, free + 1); parts across and along the path.
        whole = jnp.concatenate([slopes, (seen - pos)[..., None]], axis=2)
        along = direction * jnp.sum(direction * whole, axis=1, keepdims=True)
        known = (state - jnp.concatenate([jnp.zeros(6), means])).at[:6].set(0.0)[:free]
        mean_squared = jnp.sum(jnp.where(present, squared, 0.0)) / num

        def weigh(carry: tuple[Array, ...], _: None) -> tuple[tuple[Array, ...], tuple]:
            change, scales, overlap = carry
            variance = scales[0] + scales[1] * squared  # along the path
            white = (whole - along) * lax.rsqrt(scales[0])
            white = white + along * lax.rsqrt(variance)[:, None, None]
            left = white[..., free] - white[..., :free] @ change
            distance = jnp.sum(left * left, axis=1)
            weight = jnp.where(present, (_TAIL + 3.0) / (_TAIL + distance), 0.0)
            rows = (jnp.sqrt(weight * overlap)[:, None, None] * white).reshape(-1, free + 1)
            matrix, errors = rows[:, :free], rows[:, free]
            normal = matrix.T @ matrix + prior
            # Scaled unknowns, so that the matrix is well conditioned in single precision.
            unit = lax.rsqrt(jnp.diag(normal))
            factor = jax.scipy.linalg.cho_factor(normal * jnp.outer(unit, unit))
            covariance = jax.scipy.linalg.cho_solve(factor, jnp.diag(unit)) * unit[:, None]
            change = covariance @ (errors @ matrix - prior @ known)
            left = (errors - matrix @ change).reshape(-1, 3)
            ahead = jnp.sum(left * direction[..., 0], axis=1) ** 2
            # Numbers of unknowns that all errors, and errors along the path, determine.
            spent = free - jnp.sum(prior * covariance)
            inner = jnp.sum(direction * matrix.reshape(-1, 3, free), axis=1)
            spent_along = jnp.sum((inner @ covariance) * inner)
            # Errors of neighbours may be correlated; N observations count as (1 - r) / (1 + r) N.
            alike = jnp.sum(left[1:] * left[:-1]) / jnp.sum(left * left) + spent / (3.0 * num)
            alike = jnp.clip(alike, 0.0, 0.6)
            sums = jnp.stack(
                [(jnp.sum(left * left) - jnp.sum(ahead)) * scales[0], jnp.sum(ahead * variance)]
            )
            nums = jnp.stack([2.0 * num - (spent - spent_along), num - spent_along])
            across, variance = (sums / overlap + _WEIGHT * noise**2) / (
                jnp.maximum(nums, 1.0) + _WEIGHT
            )
            scales = jnp.stack([across, jnp.maximum(variance - across, 0.0) / mean_squared])
            far = jnp.sum(present & (distance > _FAR), dtype=num.dtype) / num
            return (change, scales, (1.0 - alike) / (1.0 + alike)), (covariance, far)

        begun = (jnp.zeros_like(state[:free]), *weights)
        (change, *weights), found = lax.scan(weigh, begun, None, length=_WEIGHINGS)
        return (state.at[:free].add(change), *weights), jax.tree.map(lambda leaf: leaf[-1], found)

    scales = jnp.stack([jnp.maximum(0.6 * error, noise**2), jnp.zeros_like(noise)])
    begun = state, scales, jnp.ones_like(noise)
    (state, scales, overlap), (covariance, far) = lax.scan(
        linearise, begun, None, length=_ROUNDS[counts[0] > 0 or not is_short]
    )
    size = jnp.linalg.norm(scaled @ state[7:10])
    axial = jnp.zeros(_UNKNOWNS).at[7:10].set(spreads[0] * forward)
    whole = jnp.diag(spread.at[:free].set(0.0) ** 2).at[:free, :free].set(covariance[-1])
    covariance = whole + (jnp.outer(axial, axial) if is_short else 0.0)
    # The error along the path must be small beside the extent of the recording.
    extent = jnp.max(seen, axis=0) - jnp.min(seen, axis=0)
    error = scales[0] + scales[1] * jnp.sum(state[3:6] ** 2)
    sound = (error <= _MOST_NOISE**2 * jnp.sum(extent**2)) & (size <= _MOST_LIFT)
    sound &= jnp.isfinite(jnp.sum(covariance)) & (far[-1] <= _MOST_OUTLIERS)
    # Spin that the prior excludes leaves smooth errors; another frame leaves errors that alternate.
    verdict = jnp.where(sound, 1.0, jnp.where(overlap < 0.5, -1.0, 0.0)).astype(rows.dtype)
    scales = scales.at[1].add(state[10] ** 2 * delay)
    results = jnp.stack([*scales, last, floor, far[-1], verdict])
    return jnp.concatenate([state, covariance.reshape(-1), results])


def _stamps(times: Array, seen: Array, present: Array, num: Array) -> tuple[Array, Array]:
    """Return times, delays by the clock of a periodic camera, and drift (3, N) [s], and variance.

    A delay makes a step in time longer, but not the ball's step; an outlier does the opposite. The
    smaller ratio of a step to the median step is the number of periods. The drift ends at zero.
    """
    steps = jnp.stack([jnp.diff(times), jnp.linalg.norm(jnp.diff(seen, axis=0), axis=1)])
    middle = (0.5 * (num - 1.0)).astype(jnp.int32)
    median = jnp.sort(jnp.where(present[1:], steps, jnp.inf), axis=1)[:, middle]
    ratios = jnp.min(steps / at_least(median, 1e-9)[:, None], axis=0)
    frames = jnp.cumsum(jnp.maximum(jnp.round(ratios), 1.0), dtype=times.dtype)
    frames = jnp.concatenate([jnp.zeros(1), jnp.where(present[1:], frames, 0.0)])
    weight, late, squared = jnp.where(present, 1.0, 0.0), times, num
    for _ in range(_WEIGHINGS):  # a regression with Student's t distribution
        far, away = (x - jnp.sum(weight * x) / jnp.sum(weight) for x in (frames, times))
        period = jnp.sum(weight * far * away) / jnp.sum(weight * far**2)
        late = jnp.where(present, away - period * far, 0.0)
        squared = jnp.sum(weight * late**2) / (num - 2.0) + 1e-12
        weight = jnp.where(present, (_TAIL + 1.0) / (_TAIL + late**2 / squared), 0.0)
    return jnp.stack([times, late, jnp.sqrt(squared) * (times / jnp.max(times) - 1.0)]), squared


def _forecast(fitted: Array, times: Array, numbers: Array, counts: tuple[int, int]) -> Array:
    """Predict one flight at times (T,) after a result of `_estimate`.

    The result (T, 24) has positions, velocities, and covariances of true and observed positions.
    """
    state, covariance, (*scales, span, floor, _, _) = _unpack(fitted)
    num = _UNKNOWNS if counts[0] else _BEFORE
    stamps = jnp.zeros((3, *times.shape)).at[0].set(times)
    slopes, (pos, vel) = _linearise(num, state, stamps, numbers, floor, counts)
    sure = jnp.einsum("nik,kl,njl->nij", slopes, covariance[:num, :num], slopes)
    after = jnp.maximum(times - 0.5 * span, 0.0)
    eye = jnp.eye(3, dtype=pos.dtype)[None]
    sure = sure + (numbers[12] * after**3 / 3.0)[:, None, None] * eye
    stamps = scales[1] * jnp.einsum("ni,nj->nij", vel, vel)
    seen = sure + scales[0] * eye + stamps
    return jnp.concatenate([pos, vel, sure.reshape(-1, 9), seen.reshape(-1, 9)], axis=1)
