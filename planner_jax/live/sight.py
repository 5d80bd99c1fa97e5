"""Kalman filter of one observed ball, which rejects outliers and restarts for another ball."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import ArrayLike

from planner_jax.ball import estimation
from planner_jax.ball.estimation import EkfModel, EkfState, Flight
from planner_jax.ball.flight import BallState
from planner_jax.live.packets import Fault
from planner_jax.planning.programs import call_packed

_SPREAD = 15.0  # [m/s], assumed standard deviation of the velocity at the first observation
_DENSITY = 0.01  # [m^2/s^3], power spectral density of accelerations not in the flight model
# An observation is an outlier if its Mahalanobis distance from the prediction is above this number.
_GATE = 5.0
_OTHERS = 5  # number of consecutive outliers after which the filter deletes its estimate
_FORGOTTEN = 0.3  # [s], time without an observation after which the filter deletes its estimate
_LEAST = 3  # least number of observations from which the velocity counts as known


@struct.dataclass
class Observation:
    """Input of a Kalman filter step: a Gaussian estimate of the ball, and a later observation."""

    belief: EkfState
    since: Array  # () [s], time from the belief to the observation
    pos: Array  # (3,) [m], observed position
    ahead: Array  # () [s], time from the observation to the requested prediction


@struct.dataclass
class Estimate:
    """Output of a Kalman filter step: updated estimate, and the ball predicted at a later time."""

    belief: EkfState
    is_outlier: Array  # () bool, whether the observation was rejected
    spread: Array  # () [m/s], greatest standard deviation of a velocity component
    ball: BallState  # predicted ball


def _filter(flight: Flight, model: EkfModel, seen: Observation) -> Estimate:
    belief = estimation.ekf_predict(seen.belief, seen.since, model, flight=flight)
    away = seen.pos - belief.mean[:3]
    noise = jnp.diag(jnp.ones(3, away.dtype) * model.observation_std**2)
    spread = belief.covariance[:3, :3] + noise
    is_outlier = jnp.sum(away * estimation.solve_definite(spread, away[:, None])[:, 0]) > _GATE**2
    belief = estimation.ekf_update(belief, jnp.where(is_outlier, jnp.nan, seen.pos), model)
    variances = jnp.diag(belief.covariance)[3:]
    ball = flight(belief.ball, seen.ahead, model.drag, model.gravity)
    return Estimate(belief, is_outlier, jnp.sqrt(jnp.max(variances)), ball)


class Sight:
    """Estimate of position and velocity of one ball from its observed positions.

    Args:
        flight: function (ball, duration, drag, gravity) -> ball after the duration.
        drag: drag of the ball, in the unit that `flight` expects.
        gravity: [m/s^2], magnitude.
        noise: [m], standard deviation of an observed coordinate.
    """

    def __init__(self, flight: Flight, drag: ArrayLike, gravity: float, noise: float) -> None:
        self._flight, self._noise = flight, noise
        numbers = (drag, gravity, _DENSITY, noise)
        self._model = EkfModel(*(jnp.asarray(x, jnp.float32) for x in numbers))
        self.forget()

    def forget(self) -> None:
        """Delete the estimate; the next observation starts a new one."""
        self._belief: EkfState | None = None  # NumPy leaves
        self.number: int | None = None
        self.spread = math.inf  # [m/s], greatest standard deviation of a velocity component
        self._time = -math.inf
        self._num = self._outliers = 0

    def is_known(self, spread: float) -> bool:
        """Test whether the velocity's standard deviation is at most `spread` [m/s] on each axis."""
        return self._num >= _LEAST and self.spread <= spread

    def see(
        self, number: int, pos: tuple[float, ...], measured: float, until: float
    ) -> tuple[BallState | None, Fault]:
        """Update the estimate, and predict the ball at the time `until` [s].

        The ball `number` was observed at `pos` (3,) [m] at the time `measured` [s]. Returns the
        predicted ball, or None at the first observation and after a fault; and the fault, which is
        the reason why the observation is not used, or `Fault.NONE`.
        """
        belief = self._belief
        if belief is None or number != self.number or measured - self._time > _FORGOTTEN:
            self._start(number, pos, measured)
            return None, Fault.NONE
        if measured <= self._time:
            return None, Fault.STALE
        times_and_pos = measured - self._time, pos, max(until - measured, 0.0)
        numbers: Any = [np.asarray(x, np.float32) for x in times_and_pos]
        seen = Observation(belief, *numbers)
        found: Estimate = call_packed(_filter, self._flight, self._model, seen)
        if found.is_outlier:
            self._outliers += 1
            if self._outliers >= _OTHERS:
                self._start(number, pos, measured)
            return None, Fault.OUTLIER
        self._belief, self._time, self.spread = found.belief, measured, float(found.spread)
        self._num, self._outliers = self._num + 1, 0
        return found.ball, Fault.NONE

    def _start(self, number: int, pos: tuple[float, ...], measured: float) -> None:
        stds = [self._noise] * 3 + [_SPREAD] * 3
        mean: Any = np.array([*pos, 0.0, 0.0, 0.0], np.float32)
        covariance: Any = np.diag(np.square(stds)).astype(np.float32)
        self._belief = EkfState(mean=mean, covariance=covariance)
        self.number, self._time, self.spread = number, measured, math.inf
        self._num, self._outliers = 1, 0
