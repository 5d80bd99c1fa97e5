"""Prediction of moving targets in the plane from noisy observed positions, with its uncertainty.

A bank of Kalman filters (`filter_bank.py`) explains the observations by several hypotheses, such as
a steady velocity, a stop or a turn. The prediction is a mixture of Gaussians: the expected path is
the mean of the hypotheses, and the stated uncertainty is a quantile of the whole mixture.
"""

from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chndtr

from planner_jax.core.checks import require_number, shape_of
from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.core.rules import POSITIVE
from planner_jax.plane.filter_bank import (
    SETTLE,
    VOLATILITY,
    Mixture,
    diffusion,
    fading,
    fit_bank,
    transition,
)
from planner_jax.plane.target import FadingPath

_MOST = 60  # greatest number of observations that are used, the latest ones
# After the last observation the volatility is drawn anew. Columns: probabilities of the squared
# volatilities 1e-4, 1e-3, 1e-2 and 1e-1 [1/s]. Rows: the motion was steady, with a volatility of
# less than 0.1, 0.1, or more; the motion has changed, or turns.
_STEADY = ((0.70, 0.05, 0.14, 0.11), (0.26, 0.27, 0.39, 0.08), (0.47, 0.08, 0.19, 0.26))
_FUTURE = np.array([*_STEADY, (0.41, 0.24, 0.02, 0.33)])
# Probabilities of squared usual speeds, if unknown: 1, 10, 100 and 1000 observed squared speeds.
_FASTER = np.array([0.75, 0.19, 0.05, 0.01])


@dataclass(frozen=True)
class Prediction:
    """Predicted path of one target or of B targets, and how uncertain it is.

    Time 0 is the time of the last observation, or the time `now` that was passed. The arrays have
    the shape (), or (B,) for a batch.

    Attributes:
        path: expected path, which `pj.intercept.case` accepts as target.
        has_changed: bool, whether a change was noticed: a stop, turn or other manoeuvre.
        since: [s], expected time of this change, at most 0; NaN if none was noticed.
        chance_changed: probability that the motion changed during the observations.
        noise: [m], standard deviation of an observed coordinate, passed or estimated.
        mixture: hypotheses about the motion, with their probabilities, from which `path` is
            computed.
        speed: [m/s], usual speed of the targets, if it was passed.
    """

    path: FadingPath
    has_changed: np.ndarray
    since: np.ndarray
    chance_changed: np.ndarray
    noise: np.ndarray
    mixture: Mixture
    speed: float | None

    def radius(self, time: float | ArrayLike, share: float = 0.9) -> np.ndarray:
        """Return the radius [m] of the disc around the path that holds the target.

        The target is in the disc around `path.at(time).pos` with the probability `share`. The
        radius is infinite if the observations determine no speed. Before the last observation it is
        constant.

        Args:
            time: [s], one time, times (B,) of a batch, or times (T,) of one target.
            share: probability, greater than 0 and less than 1.
        """
        require(0.0 < share < 1.0, "share", "> 0 and < 1", share)
        after = np.maximum(np.asarray(time, float) + np.asarray(self.path.ahead), 0.0)
        found = _radius(*_forecast(self.mixture, after.reshape(-1, 1), self.speed), share)
        return np.where(self.mixture.is_known, found, np.inf).reshape(after.shape)


def predict(
    times: ArrayLike,
    positions: ArrayLike,
    noise: float | None = None,
    *,
    now: float | None = None,
    speed: float | None = None,
) -> Prediction:
    """Predict where one target, or each of B targets, will be, and how uncertain that is.

    The target may stand, move, stop, turn and move on, and single observations may be outliers.
    Observations of a few seconds suffice, and the latest 60 are used. With a single observation, or
    with all observations at one time, the predicted target stands and its disc is infinite.

    Args:
        times: (L,) or (B, L) [s], times of L observations, in any order.
        positions: (L, 2) or (B, L, 2) [m], observed positions, in any unit of length. An
            observation is absent if its position or its time is NaN.
        noise: [m] > 0, standard deviation of a coordinate of an observation. By default it is
            estimated from the distances of observations from the line between their neighbours;
            for two observations it is assumed to be a tenth of their distance.
        now: [s], time on the clock of `times` at which the path has its time 0. By default this is
            the time of each target's last observation.
        speed: [m/s] > 0, usual speed of such targets, such as 1.3 m/s for pedestrians. The discs of
            slower targets allow for this speed. If it is unknown, it may exceed the observed speed,
            but a target that stands is expected to stand on.

    Raises:
        ArgumentError: the shapes do not match, a number is infinite, the noise or the speed is not
            positive, or a target has no observation.
    """
    for name, value in (("times", times), ("positions", positions)):
        shape_of(name, value)
    clock, points = np.asarray(times, float), np.asarray(positions, float)
    shape = points.shape[:-1]
    rule = "of the shape (L, 2) or (B, L, 2)"
    require(points.ndim in (2, 3) and points.shape[-1] == 2, "positions", rule, points.shape)
    rule = " or ".join(f"{each}" for each in dict.fromkeys((shape[-1:], shape)))
    rule = f"of the shape {rule}, as positions"
    require(clock.shape in (shape, shape[-1:]), "times", rule, clock.shape)
    for name, array in (("times", clock), ("positions", points)):
        require(not np.isinf(array).any(), name, "finite, or NaN if absent", np.inf)
    for name, value, rule in (("noise", noise, POSITIVE), ("speed", speed, POSITIVE)):
        if value is not None:
            require_number(name, value, rule)
    if now is not None:
        require_number("now", now)
    require(points.size > 0, "positions", "of at least one observation", shown="none")
    clock = np.broadcast_to(clock, shape).reshape(-1, shape[-1])
    places = (points[..., 0] + 1j * points[..., 1]).reshape(clock.shape)
    present = ~np.isnan(clock) & ~np.isnan(places)
    count = present.sum(axis=-1)
    if np.any(count == 0):
        index = int(np.argmin(count)) if len(shape) > 1 else None
        raise ArgumentError("positions", "of at least one observation", index=index, shown="none")
    order = np.argsort(np.where(present, clock, np.inf), axis=-1, kind="stable")
    clock, places = (np.take_along_axis(each, order, axis=-1) for each in (clock, places))
    groups, fits = [], []
    for size in np.unique(count):  # targets with equal numbers of observations share the arrays
        groups.append(np.flatnonzero(count == size))
        part = np.ix_(groups[-1], np.arange(max(size - _MOST, 0), size))
        fits.append(fit_bank(clock[part], places[part], noise))
    back = np.argsort(np.concatenate(groups))
    fit = jax.tree.map(lambda *parts: np.concatenate(parts)[back], *fits)
    last = np.arange(len(count)), count - 1
    ahead = np.zeros(len(count)) if now is None else now - clock[last]
    has_changed = fit.chance_changed > 0.5
    since = np.where(has_changed, fit.since - ahead, np.nan)
    path = (*_mean_path(fit.mixture, places[last]), ahead)
    found = {"has_changed": has_changed, "since": since}
    found |= {"chance_changed": fit.chance_changed, "noise": fit.noise}
    outer = shape[:-1]
    path, found = jax.tree.map(lambda each: each.reshape((*outer, *each.shape[1:])), (path, found))
    return Prediction(path=FadingPath(*path), mixture=fit.mixture, speed=speed, **found)


def _forecast(
    mixture: Mixture, time: np.ndarray, speed: float | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return chances, distances from the path, and variances of positions at times (T, 1) [s].

    The arrays broadcast to the shape (T, K, J), for J volatilities after the last observation.
    These are relative to the observed speed, and may be greater if the usual speed is unknown.
    """
    along = _transition(mixture, time, mixture.turn)
    mean = (along * mixture.state).sum(axis=-1)
    variance = along[..., None, :] @ mixture.covariance @ np.conj(along[..., None])
    variance = np.real(variance[..., 0, 0])
    expected = (_transition(mixture, time, _mean_turn(mixture)) * mixture.state).sum(axis=-1)
    distance = np.abs(mean - (mixture.chance * expected).sum(axis=1, keepdims=True))
    usual, faster = np.maximum(mixture.speed, speed or 0.0), np.ones(1) if speed else _FASTER
    unit = np.ones_like(mixture.turn), SETTLE[mixture.settle], usual, mixture.turn
    spread = np.real(diffusion(time, *unit)[..., 0, 0])
    future = np.stack([np.convolve(row, faster) for row in _FUTURE])
    variance = variance[..., None] + spread[..., None] * 10.0 ** (np.arange(future.shape[1]) - 4.0)
    kind = np.where(mixture.has_changed, 3, np.clip(mixture.volatility - 1, 0, 2))
    return mixture.chance[..., None] * future[kind], distance[..., None], variance


def _transition(mixture: Mixture, time: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return the expected first rows (..., 3) of the transitions within times (T, 1) [s].

    A turn ends at a random time t with the density r exp(-r t). The expectation of the velocity is
    a sum of two velocities: one keeps its direction, and one turns and decays at the rate r.
    """
    level, settle = VOLATILITY[mixture.volatility], SETTLE[mixture.settle]
    turning = transition(time, level, settle, turn + 1j * mixture.end)[..., 0, :]
    straight = transition(time, level, settle, np.zeros_like(turn))[..., 0, :]
    return turning + _share_straight(mixture, turn)[..., None] * (straight - turning)


def _share_straight(mixture: Mixture, turn: np.ndarray) -> np.ndarray:
    """Return the complex share (N, K) of a velocity that remains when a turn has ended."""
    rate = np.where(turn == 0.0, 1.0, mixture.end)
    return rate / (rate - 1j * turn)


def _radius(
    chance: np.ndarray, distance: np.ndarray, variance: np.ndarray, share: float
) -> np.ndarray:
    """Return radii (T,) of discs that hold the share of a mixture of Gaussians, each (T, K, J)."""
    deviation = np.maximum(np.sqrt(variance), np.maximum(1e-2 * distance, 1e-100))
    offset = (distance / deviation) ** 2
    low, high = np.zeros(len(variance)), (distance + 6.0 * deviation).max(axis=(1, 2))
    for _ in range(40):
        radius = 0.5 * (low + high)
        inside = chndtr((radius[:, None, None] / deviation) ** 2, 2.0, offset)
        is_large = (chance * inside).sum(axis=(1, 2)) > share
        low, high = np.where(is_large, low, radius), np.where(is_large, radius, high)
    return high


def _mean_turn(mixture: Mixture) -> np.ndarray:
    """Return turn rates (N, K) [rad/s], with the mean turn rate of all hypotheses that turn."""
    turns = mixture.chance * (mixture.turn != 0.0)
    mean = (turns * mixture.turn).sum(axis=1) / np.maximum(turns.sum(axis=1), 1e-300)
    return np.where(mixture.turn != 0.0, mean[:, None], 0.0)


def _mean_path(mixture: Mixture, last: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the first four leaves of a `FadingPath`: the mean paths of N mixtures.

    `last` has the last observed positions (N,) complex [m]. Hypotheses that turn get their mean
    turn rate, so that the path has few terms.
    """
    num, row = len(last), np.arange(len(last))[:, None]
    share = mixture.chance[..., None] * mixture.state
    # An acceleration a that decays within s displaces like velocities a s and -a s that decay at
    # different rates: without s, and with it. The columns of `flat` stand for: turn or not,
    # volatility, and no correlation time or one of them.
    extra = share[..., 2] * SETTLE[mixture.settle]
    turn, ended = _mean_turn(mixture), _share_straight(mixture, _mean_turn(mixture))
    flat = np.zeros((num, 2 * len(VOLATILITY) * (1 + len(SETTLE))), complex)
    for turns, part in enumerate((ended, 1.0 - ended)):
        column = (turns * len(VOLATILITY) + mixture.volatility) * (1 + len(SETTLE))
        np.add.at(flat, (row, column), part * (share[..., 1] + extra))
        np.add.at(flat, (row, column + 1 + mixture.settle), -part * extra)
    rate = fading(VOLATILITY)[:, None] + np.array([0.0, *1.0 / SETTLE])
    rate = (rate + np.stack([0.0 * mixture.end, mixture.end], axis=1)[..., None]).reshape(num, -1)
    turn = np.stack([np.zeros(num), turn[row[:, 0], np.abs(turn).argmax(axis=1)]], axis=1)
    turn = np.repeat(turn, flat.shape[1] // 2, axis=1)
    both = last + share[..., 0].sum(axis=1), flat
    pos, vel = (np.stack([np.real(each), np.imag(each)], axis=-1) for each in both)
    return pos, vel, rate, turn
