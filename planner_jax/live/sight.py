"""The ball as it is seen: a Kalman filter that other balls and slips of the camera do not spoil."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.estimation import (
    EkfModel,
    EkfState,
    Flight,
    ekf_predict,
    ekf_update,
    solve_definite,
)
from planner_jax.ball.flight import BallState
from planner_jax.live.export_cache import traced
from planner_jax.live.packets import Fault
from planner_jax.planning.single_call import call_packed

_SPREAD = 15.0  # [m/s], of the velocity before anything is known of it
_DENSITY = 0.01  # [m^2/s^3], of what the flight leaves out
_GATE = 5.0  # standard deviations, farther away is another ball or a slip
_OTHERS = 5  # such in a row are another ball
_FORGOTTEN = 0.3  # [s] without a look
_LEAST = 3  # looks, before which nothing is known


@struct.dataclass
class Look:
    """What the filter gets; its time is that of the belief."""

    belief: EkfState
    since: Array  # () [s], since the belief
    observation: Array  # (3,) [m]
    ahead: Array  # () [s], for which the ball is predicted


@struct.dataclass
class Seen:
    """What the filter makes of it."""

    belief: EkfState
    outlier: Array  # () bool, the observation is not used
    spread: Array  # () [m/s], greatest standard deviation of the velocity
    ball: BallState  # `ahead` after the observation


def _looked(flight: Flight, model: EkfModel, look: Look) -> Seen:
    belief = ekf_predict(look.belief, look.since, model, flight=flight)
    away = look.observation - belief.mean[:3]
    noise = jnp.diag(jnp.ones(3, away.dtype) * model.observation_std**2)
    spread = belief.covariance[:3, :3] + noise
    outlier = jnp.sum(away * solve_definite(spread, away[:, None])[:, 0]) > _GATE**2
    belief = ekf_update(belief, jnp.where(outlier, jnp.nan, look.observation), model)
    variances = jnp.diag(belief.covariance)[3:]
    ball = flight(belief.ball, look.ahead, model.drag, model.gravity)
    return Seen(belief, outlier, jnp.sqrt(jnp.max(variances)), ball)


class Sight:
    """What is believed of one ball.

    Args:
        flight: of the ball.
        drag: as the flight takes it.
        gravity: [m/s^2].
        noise: [m], standard deviation of a coordinate that is observed.
    """

    def __init__(self, flight: Flight, drag: Any, gravity: float, noise: float) -> None:
        self._flight, self._noise = flight, noise
        numbers = (drag, gravity, _DENSITY, noise)
        self._model = EkfModel(*(jnp.asarray(x, jnp.float32) for x in numbers))
        self.forget()

    def forget(self) -> None:
        """Expect another ball."""
        self._belief: Any = None  # an `EkfState` with NumPy leaves
        self.number: int | None = None
        self.spread = np.inf  # [m/s], of the velocity
        self._time = -np.inf
        self._looks = self._outliers = 0

    def is_known(self, spread: float) -> bool:
        """Whether the velocity is known to a standard deviation [m/s]."""
        return self._looks >= _LEAST and self.spread <= spread

    def see(
        self, number: int, observation: tuple[float, ...], measured: float, until: float
    ) -> tuple[BallState | None, Fault]:
        """The ball at a time, NumPy leaves (3,), None if it is seen for the first time.

        Args:
            number: of the ball.
            observation: (3,) [m].
            measured: [s], when that was.
            until: [s], for which the ball is predicted.
        """
        if number != self.number or measured - self._time > _FORGOTTEN:
            self._begin(number, observation, measured)
            return None, Fault.NONE
        if measured <= self._time:
            return None, Fault.STALE
        seen = self._look(observation, measured - self._time, until - measured)
        if seen.outlier:
            self._outliers += 1
            if self._outliers >= _OTHERS:
                self._begin(number, observation, measured)
            return None, Fault.OUTLIER
        self._belief, self._time, self.spread = seen.belief, measured, float(seen.spread)
        self._looks, self._outliers = self._looks + 1, 0
        return seen.ball, Fault.NONE

    def rehearse(self, until: float) -> BallState | None:
        """A look at the ball where it was seen last, which changes nothing; None without one."""
        if self._belief is None:
            return None
        return self._look(tuple(self._belief.mean[:3].tolist()), 0.0, until - self._time).ball

    def _look(self, observation: tuple[float, ...], since: float, ahead: float) -> Seen:
        given: Any = (since, observation, max(ahead, 0.0))
        numbers: Any = [np.asarray(x, np.float32) for x in given]
        look = Look(self._belief, *numbers)
        return call_packed(_looked, self._flight, self._model, look, compiler=traced)

    def _begin(self, number: int, observation: tuple[float, ...], measured: float) -> None:
        stds = [self._noise] * 3 + [_SPREAD] * 3
        mean: Any = np.array([*observation, 0.0, 0.0, 0.0], np.float32)
        covariance: Any = np.diag(np.square(stds)).astype(np.float32)
        self._belief = EkfState(mean=mean, covariance=covariance)
        self.number, self._time, self.spread = number, measured, np.inf
        self._looks, self._outliers = 1, 0
