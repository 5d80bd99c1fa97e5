"""Kalman filters of observed balls, which reject outliers and false detections."""

import dataclasses
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
_DECAY = 0.8  # factor on an estimate's score at every observation of its ball
_MOST = 3  # greatest number of estimates of a ball
_FORGOTTEN = 0.3  # [s], time without an observation after which an estimate is deleted
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


@dataclasses.dataclass(eq=False)
class _Track:
    """A Kalman filter's estimate of one ball, or of what was detected in its place."""

    number: int  # of the ball
    belief: EkfState  # NumPy leaves
    time: float  # [s], of the last observation that was used
    num: int = 1  # number of observations that were used
    spread: float = math.inf  # [m/s], greatest standard deviation of a velocity component
    score: float = 1.0  # number of used observations; earlier observations count less


class Sight:
    """Estimates of positions and velocities of balls from their observed positions.

    An observation that contradicts all estimates of its ball starts another one. The estimate that
    explains most of the latest observations is the ball; others, such as of a false detection that
    stands still, are kept for a while.

    Args:
        flight: function (ball, duration, drag, gravity) -> ball after the duration.
        drag: drag of the balls, in the unit that `flight` expects.
        gravity: [m/s^2], magnitude.
        noise: [m], standard deviation of an observed coordinate.
    """

    def __init__(self, flight: Flight, drag: ArrayLike, gravity: float, noise: float) -> None:
        self._flight, self._noise = flight, noise
        numbers = (drag, gravity, _DENSITY, noise)
        self._model = EkfModel(*(jnp.asarray(x, jnp.float32) for x in numbers))
        self.begun = 0  # number of balls whose observation began
        self.forget()

    def forget(self) -> None:
        """Delete all estimates; the next observation starts a new one."""
        self._tracks: list[_Track] = []  # of each ball the best estimate is the first one

    def _of(self, number: int) -> list[_Track]:
        return [track for track in self._tracks if track.number == number]

    def _sort(self) -> None:
        self._tracks.sort(key=lambda track: -track.score)

    def is_known(self, number: int, spread: float) -> bool:
        """Test whether the velocity's standard deviation is at most `spread` [m/s] on each axis."""
        return any(t.num >= _LEAST and t.spread <= spread for t in self._of(number)[:1])

    def is_seen(self, number: int) -> bool:
        """Test whether a ball was observed within 0.3 s before the last observation of any ball."""
        return bool(self._of(number))

    def see(
        self, number: int, pos: tuple[float, ...], measured: float, until: float
    ) -> tuple[BallState | None, Fault]:
        """Update the estimates, and predict the ball at the time `until` [s].

        The ball `number` was observed at `pos` (3,) [m] at the time `measured` [s]. Returns the
        predicted ball, or None at the first observation and after a fault; and the fault, which is
        the reason why the observation is not used, or `Fault.NONE`.
        """
        self._tracks = [t for t in self._tracks if measured - t.time <= _FORGOTTEN]
        own = self._of(number)
        if not own:
            self.begun += 1
            self._start(number, pos, measured)
            return None, Fault.NONE
        if measured <= max(track.time for track in own):
            return None, Fault.STALE
        for track in own:
            track.score *= _DECAY
        for track in own:
            if (ball := self._update(track, pos, measured, until)) is not None:
                self._sort()
                is_best = self._of(number)[0] is track
                return (ball, Fault.NONE) if is_best else (None, Fault.OUTLIER)
        if len(own) >= _MOST:
            self._tracks.remove(min(own, key=lambda each: each.score))
        self._start(number, pos, measured)
        return None, Fault.OUTLIER

    def _update(
        self, track: _Track, pos: tuple[float, ...], measured: float, until: float
    ) -> BallState | None:
        """Update an estimate, and return the predicted ball; None if `pos` is an outlier."""
        times_and_pos = measured - track.time, pos, max(until - measured, 0.0)
        numbers: Any = [np.asarray(x, np.float32) for x in times_and_pos]
        seen = Observation(track.belief, *numbers)
        found: Estimate = call_packed(_filter, self._flight, self._model, seen)
        if found.is_outlier:
            return None
        track.belief, track.time, track.spread = found.belief, measured, float(found.spread)
        track.num, track.score = track.num + 1, track.score + 1.0
        return found.ball

    def _start(self, number: int, pos: tuple[float, ...], measured: float) -> None:
        stds = [self._noise] * 3 + [_SPREAD] * 3
        mean: Any = np.array([*pos, 0.0, 0.0, 0.0], np.float32)
        covariance: Any = np.diag(np.square(stds)).astype(np.float32)
        self._tracks.append(_Track(number, EkfState(mean=mean, covariance=covariance), measured))
        self._sort()
