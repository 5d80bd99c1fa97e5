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
from dataclasses import astuple, dataclass, fields
from typing import Self

import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from planner_jax.ball.recording_program import (
    MOST_EXPONENT,
    WEIGHT,
    compile_program,
    estimate,
    forecast,
    next_size,
    num_steps,
    unpack,
)
from planner_jax.core import GRAVITY
from planner_jax.core.checks import numbers_of, require_number, shape_of
from planner_jax.core.choices import require, require_one_of
from planner_jax.core.errors import CaseError, format_value
from planner_jax.core.rules import POSITIVE

_LEAST = 4  # least number of observations
_BOUNCES = 2  # number of bounces that are simulated
# Other frames of a recording: the unit of its positions [m], and the axis (1, 2 or 3) and direction
# that point up.
_FRAMES = ((1.0, 3, -1), (1.0, 1, 1), (1.0, 1, -1), (1.0, 2, 1), (1.0, 2, -1), (0.3048, 3, 1))
# Ratio of errors to the assumed noise, and length of the lift vector in standard deviations, above
# which other frames are compared.
_DOUBT = 1.5
_FAR_BETTER = 20.0  # Bayes factor for another frame, above which a recording is refused


@dataclass(frozen=True)
class Ball:
    """Properties of a ball, and of the plane on which it bounces, as known before its flight.

    The default is an unknown ball. `spin_bounce` states the model of a bounce.

    Attributes:
        drag: [1/m], median of the coefficient K_D of quadratic drag.
        drag_spread: standard deviation of log K_D.
        lift_spread: standard deviations of the lift vector, in units of K_D |v|: along the flight;
            horizontally across the flight (topspin, backspin); and perpendicular to both
            (sidespin).
        reach: [m], quotient of the surface's speed by |l|, and standard deviation of the quotient's
            logarithm.
        restitution: mean and standard deviation of the coefficient of restitution e.
        friction: mean and standard deviation of the coefficient of friction mu.
        grip: 2/5 for a hollow ball, 2/7 for a solid ball.
        density: [m^2/s^3], power spectral density of accelerations that the model lacks.
    """

    drag: float = 0.06
    drag_spread: float = 1.0
    lift_spread: tuple[float, float, float] = (0.4, 0.4, 0.4)
    reach: tuple[float, float] = (20.0, 0.3)
    restitution: tuple[float, float] = (0.8, 0.1)
    friction: tuple[float, float] = (0.3, 0.1)
    grip: float = 0.4
    density: float = 0.01

    def __post_init__(self) -> None:
        for field in fields(self):
            shape = np.shape(getattr(type(self), field.name))  # of the default
            value = numbers_of(field.name, vars(self)[field.name], (), shape)
            for each in np.ravel(value):
                require_number(field.name, each, POSITIVE)

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
    """Positions and velocities of a ball at T times, or at (B, T) times of B balls.

    Attributes:
        pos: (T, 3) [m], positions.
        vel: (T, 3) [m/s], velocities.
        covariance: (T, 3, 3) [m^2], covariances of the true positions.
        observed_covariance: (T, 3, 3) [m^2], covariances of observed positions.
        freedom: (T,) degrees of freedom of Student's t distribution of the errors.
    """

    pos: np.ndarray
    vel: np.ndarray
    covariance: np.ndarray
    observed_covariance: np.ndarray
    freedom: np.ndarray

    @property
    def is_known(self) -> np.ndarray:
        """True for times (T,) until which the flight is simulated; else all numbers are NaN."""
        return np.asarray(np.isfinite(self.pos).all(axis=-1))

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
    """Estimated flight of one ball, or of B balls, whose arrays have a leading axis (B,).

    Attributes:
        start: () [s], time of the first observation.
        pos: (3,) [m], position at the time `start`.
        vel: (3,) [m/s], velocity at the time `start`.
        drag: () [1/m], coefficient K_D of quadratic drag.
        lift: (3,) [1/s], lift vector l before the first bounce.
        noise: () [m], standard deviation of an observed coordinate across the path.
        stamp_noise: () [s], standard deviation of a time stamp.
        outliers: () share of the observations that are far from the flight.
        covariance: (15, 15) covariance of the unknowns, in the order of the module's docstring.
    """

    start: np.ndarray
    pos: np.ndarray
    vel: np.ndarray
    drag: np.ndarray
    lift: np.ndarray
    noise: np.ndarray
    stamp_noise: np.ndarray
    outliers: np.ndarray
    covariance: np.ndarray
    # Times of observations, origin, and inputs of the program of `predict`.
    _data: tuple[PyTree, ...]

    def predict(self, times: ArrayLike) -> Prediction:
        """Predict the ball at times (T,), or (B, T) for a batch, on the recording's clock [s].

        With `floor`, a prediction ends when the ball comes to the plane after its second bounce.
        Then all its numbers are NaN, and `is_known` is False.

        Raises:
            ArgumentError: a time is not finite, before the first observation, or so late that the
                flight is too long for the integration, or the shape is another one.
        """
        shape, batch = shape_of("times", times), self.start.shape
        fits = 0 not in shape and len(shape) in {1, 1 + len(batch)}
        require(fits, "times", "of the shape (T,) or (B, T)", shape)
        times = np.broadcast_to(np.asarray(times, np.float64), (*batch, shape[-1]))
        after, numbers = times - self.start[..., None], self._data[4]
        # Latest time: the ball has flown MOST_EXPONENT / K_D in the direction of its velocity.
        speed, longest = np.abs(self.vel).max(axis=-1), MOST_EXPONENT / numbers[0]
        latest = (np.sqrt(speed**2 + 2.0 * numbers[13] * longest) - speed) / numbers[13]
        late = f"at most {np.min(latest):.3g} s after the first one"
        for holds, rule in (
            (np.isfinite(times), "finite"),
            (after >= 0.0, "at or after the first one"),
            (after <= latest[..., None], late),
        ):
            shown = f"{times.flat[np.argmin(holds)]:.9g} s"
            require(bool(holds.all()), "times", rule, shown=shown)
        return self._predict(after)

    def smooth(self) -> Prediction:
        """Return the ball at the times of the observations; absent times are the first one."""
        return self._predict(np.nan_to_num(self._data[0] - self.start[..., None]))

    def _predict(self, after: np.ndarray) -> Prediction:
        _, origin, freedom, fitted, numbers, bounces = self._data
        rows, num = after.reshape(-1, after.shape[-1]), after.shape[-1]
        lanes = np.minimum(np.arange(len(fitted)), len(rows) - 1)
        padded = rows[lanes][:, np.minimum(np.arange(next_size(num)), num - 1)]
        last = after.max(axis=-1)
        distance = last * np.abs(self.vel).max(axis=-1) + 0.5 * numbers[13] * last**2
        program = compile_program(forecast, bounces, num_steps(numbers[0] * distance.max()))
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
            the ball's radius; None if there is no plane. Two bounces are simulated; a prediction
            ends when the ball comes to the plane for the third time.
        gravity: [m/s^2], magnitude.
        wind: (3,) [m/s], constant velocity of the air.
        noise: [m], expected standard deviation of a coordinate. It counts as four observations.

    Raises:
        ArgumentError: a shape does not match, or a number is out of range.
        CaseError: times do not increase, a recording has fewer than four observations, no single
            flight explains more than half of it, its lift is far greater than `ball` allows, most
            of it is below the floor, or a flight in a frame whose z axis does not point up, or in
            feet, explains it far better.
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
    is_shape = len(shape) in (2, 3) and shape[-1] == 3 and 0 not in shape
    require(is_shape, "positions", "of the shape (N, 3) or (B, N, 3), not empty", shape)
    for name, value, rule in (("times", times, shape[:-1]), ("wind", wind, (3,))):
        require(shape_of(name, value) == rule, name, f"of the shape {rule}", np.shape(value))
    require(bool(np.isfinite(np.asarray(wind, np.float64)).all()), "wind", "finite", wind)
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
    first, lanes = rows[:, 0].copy(), 1 if len(rows) == 1 else next_size(len(rows), 64)
    rows = rows - first[:, None]
    padded = _pad(rows, lanes)
    bounces, observed, floors = 0, 0, np.zeros(lanes, np.float32)
    if floor is not None:
        require_number("floor", floor)
        floors[: len(rows)] = floor - first[:, 3]
        above = np.nanmedian(rows[..., 3], axis=-1) > floors[: len(rows)]
        _require(above, batch, "floor", "below most positions of the ball", format_value(floor))
        low, high = np.nanmin(rows[..., 3], axis=-1), np.nanmax(rows[..., 3], axis=-1)
        bounces = _BOUNCES
        observed = _BOUNCES if np.any(low - floors[: len(rows)] < 0.5 * (high - low)) else 0
    air = np.asarray(wind, np.float64)
    numbers = _pack(ball, (float(gravity), *air.tolist(), float(noise)))
    distance = float(np.fmax.reduce(np.abs(padded[..., 1:]), axis=None))
    program = compile_program(estimate, observed, num_steps(ball.drag * distance))
    fitted = np.asarray(program(padded, floors, numbers))
    found = fitted[: len(rows)].reshape((*batch, -1)).astype(np.float64)
    state, covariance, others = unpack(found)
    verdict, rule = others[..., 5], "of one flight in one frame, except for less than half"
    smooth = "of a flight with the lift and drag of `ball`; errors of neighbours are alike"
    _require(verdict >= 0.0, batch, "positions", smooth)
    _require(verdict > 0.0, batch, "positions", rule)
    still = _pack(ball, (float(gravity), 0.0, 0.0, 0.0, float(noise)))
    rows[..., 1:] -= air * rows[..., :1]  # the flight beside an observer who moves with the air
    is_best = _compare_frames(rows, fitted, program, still) <= math.log(_FAR_BETTER)
    _require(is_best, batch, "positions", "of one flight in one frame in metres with z up")
    start, origin = first[:, 0].reshape(batch), first[:, 1:].reshape((*batch, 3))
    freedom = (3.0 * counts - 9.0 + WEIGHT).reshape(batch)
    pos, drag, errors = state[..., :3] + origin, np.exp(state[..., 6]), np.sqrt(others[..., :2])
    data = clock.reshape(shape[:-1]), origin, freedom, fitted, numbers, bounces
    beside = errors[..., 0], errors[..., 1], others[..., 4], covariance, data
    return FlightFit(start, pos, state[..., 3:6], drag, state[..., 7:10], *beside)


@functools.lru_cache
def _pack(ball: Ball, others: tuple[float, ...]) -> np.ndarray:
    packed = [float(x) for each in astuple(ball) for x in np.atleast_1d(each)]
    return np.array([*packed, *others], np.float32)


def _pad(rows: np.ndarray, lanes: int) -> np.ndarray:
    """Return recordings (B, N, 4) as float32 with as many lanes and rows as compiled programs."""
    padded = np.full((lanes, next_size(rows.shape[1]), 4), np.nan, np.float32)
    padded[: len(rows), : rows.shape[1]] = rows
    padded[len(rows) :] = padded[0]
    return padded


def _compare_frames(
    rows: np.ndarray, fitted: np.ndarray, program: Callable, numbers: np.ndarray
) -> np.ndarray:
    """Return log Bayes factors (B,) of the best other frame of recordings (B, N, 4).

    The Bayes factor is the ratio of the probabilities of a recording, by Laplace's method.
    Recordings with small errors and a small lift need no comparison, and get -inf.
    """
    others = unpack(fitted[: len(rows)].astype(np.float64))[2]
    is_clear = (others[:, 0] <= (_DOUBT * numbers[17]) ** 2) & (others[:, 6] <= _DOUBT)
    doubtful = np.flatnonzero(~is_clear)
    others = others[doubtful]
    gains = np.full(len(rows), -np.inf)
    if not doubtful.size:
        return gains
    padded, below = _pad(rows[doubtful], len(fitted)), np.full(len(fitted), -1e6, np.float32)
    count = 3.0 * np.isfinite(rows[doubtful, :, 0]).sum(axis=-1)
    for unit, axis, sign in _FRAMES:
        turned = padded * np.array([1.0, unit, unit, unit], np.float32)
        turned[..., [axis, 3]] = turned[..., [3, axis]]
        turned[..., 3] *= sign
        found = np.asarray(program(turned, below, numbers), np.float64)[: doubtful.size]
        overlap, fits, likely = np.moveaxis(unpack(found)[2][:, -3:], -1, 0)
        fits = fits - others[:, 8] + count * math.log(unit)  # densities are per unit
        # Only independent errors count in favour of a frame, but all of them against it. Position
        # and velocity at the start have six unknowns.
        gain = np.minimum(fits, overlap * fits) + likely - others[:, 9]
        gain += 3.0 * np.log(overlap / others[:, 7]) - 6.0 * math.log(unit)
        gains[doubtful] = np.fmax(gains[doubtful], gain)
    return gains


def _require(
    holds: np.ndarray | np.bool_, batch: tuple[int, ...], name: str, rule: str, shown: str = ""
) -> None:
    if not holds.all():
        index = int(np.argmin(holds)) if batch else None
        more = int(np.size(holds) - np.sum(holds)) - 1
        raise CaseError(name, rule, index=index, shown=shown, more=more)
