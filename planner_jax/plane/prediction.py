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

from planner_jax.core.checks import shape_of
from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.plane.filter_bank import (
    SETTLE,
    VOLATILITY,
    Mixture,
    diffusion,
    fit_bank,
    transition,
)
from planner_jax.plane.target import FadingPath

_MOST = 60  # greatest number of observations that are used, the latest ones
# Volatilities after the last observation: factor, least value [1/sqrt(s)], and probability.
_FUTURE = ((1.0, 0.0, 0.6), (3.0, 0.1, 0.2), (10.0, 0.3, 0.2))


@dataclass(frozen=True)
class Prediction:
    """Predicted path of one target or of B targets, and how uncertain it is.

    Time 0 is the time of the last observation, or the time `now` that was passed. The arrays have
    the shape (), or (B,) for a batch.
    """

    path: FadingPath  # expected path, which `pj.intercept.case` accepts as target
    has_changed: np.ndarray  # bool, whether a change was noticed: a stop, turn or other manoeuvre
    since: np.ndarray  # [s], expected time of this change, at most 0; NaN if none was noticed
    chance_changed: np.ndarray  # probability that the motion changed during the observations
    noise: np.ndarray  # [m], standard deviation of an observed coordinate, passed or estimated
    mixture: Mixture

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
        found = _radius(*_forecast(self.mixture, after.reshape(-1, 1)), share)
        return np.where(self.mixture.is_known, found, np.inf).reshape(after.shape)


def predict(
    times: ArrayLike, positions: ArrayLike, noise: float | None = None, *, now: float | None = None
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

    Raises:
        ArgumentError: the shapes do not match, a number is infinite, the noise is not positive, or
            a target has no observation.
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
    require(noise is None or 0.0 < noise < np.inf, "noise", "> 0 and finite", noise)
    require(now is None or bool(np.isfinite(now)), "now", "finite", now)
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
    return Prediction(path=FadingPath(*path), mixture=fit.mixture, **found)


def _forecast(mixture: Mixture, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return chances, distances from the path, and variances of positions at times (T, 1) [s].

    Each array has the shape (T, 3 K), since three volatilities after the last observation are
    possible: the present one and two greater ones.
    """
    level, settle = VOLATILITY[mixture.volatility], SETTLE[mixture.settle]
    along = transition(time, level, settle, mixture.turn)[..., 0, :]
    mean = (along * mixture.state).sum(axis=-1)
    variance = along[..., None, :] @ mixture.covariance @ np.conj(along[..., None])
    variance = np.real(variance[..., 0, 0])
    expected = transition(time, level, settle, _mean_turn(mixture))[..., 0, :]
    centre = (mixture.chance * (expected * mixture.state).sum(axis=-1)).sum(axis=1, keepdims=True)
    distance = np.abs(mean - centre)
    parts = []
    for factor, least, chance in _FUTURE:
        future = np.maximum(factor * level, least)
        spread = diffusion(time, future, settle, mixture.speed, mixture.turn)
        shape = spread.shape[:-2]
        parts.append(
            (
                np.broadcast_to(chance * mixture.chance, shape),
                np.broadcast_to(distance, shape),
                variance + np.real(spread[..., 0, 0]),
            )
        )
    chance, distance, variance = (np.concatenate(each, axis=1) for each in zip(*parts, strict=True))
    return chance, distance, variance


def _radius(
    chance: np.ndarray, distance: np.ndarray, variance: np.ndarray, share: float
) -> np.ndarray:
    """Return radii (T,) of discs that hold the share of a mixture of M Gaussians, each (T, M)."""
    deviation = np.maximum(np.sqrt(variance), np.maximum(1e-2 * distance, 1e-100))
    offset = (distance / deviation) ** 2
    low, high = np.zeros(len(chance)), (distance + 6.0 * deviation).max(axis=1)
    for _ in range(40):
        radius = 0.5 * (low + high)
        inside = chndtr((radius[:, None] / deviation) ** 2, 2.0, offset)
        is_large = (chance * inside).sum(axis=1) > share
        low, high = np.where(is_large, low, radius), np.where(is_large, radius, high)
    return high


def _mean_turn(mixture: Mixture) -> np.ndarray:
    """Return turn rates (N, K) [rad/s], with the mean turn rate of all hypotheses that turn."""
    turns = mixture.chance * (mixture.turn != 0.0)
    total = turns.sum(axis=1, keepdims=True)
    mean = (turns * mixture.turn).sum(axis=1, keepdims=True) / np.where(total > 0.0, total, 1.0)
    return np.where(mixture.turn != 0.0, mean, 0.0)


def _mean_path(mixture: Mixture, last: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the first four leaves of a `FadingPath`: the mean paths of N mixtures.

    `last` has the last observed positions (N,) complex [m]. Hypotheses that turn get their mean
    turn rate, so that the path has few terms.
    """
    num, row = len(last), np.arange(len(last))[:, None]
    share = mixture.chance[..., None] * mixture.state
    # An acceleration a that decays within s displaces like velocities a s and -a s that decay at
    # different rates: without s, and with it. The axes of `vel` are: target, turn or not,
    # volatility, and no correlation time or one of them.
    extra = share[..., 2] * SETTLE[mixture.settle]
    turn, turns = _mean_turn(mixture), (mixture.turn != 0.0).astype(int)
    vel = np.zeros((num, 2, len(VOLATILITY), 1 + len(SETTLE)), complex)
    column = (turns * len(VOLATILITY) + mixture.volatility) * (1 + len(SETTLE))
    flat = vel.reshape(num, -1)
    np.add.at(flat, (row, column), share[..., 1] + extra)
    np.add.at(flat, (row, column + 1 + mixture.settle), -extra)
    rate = 0.5 * VOLATILITY[:, None] ** 2 + np.array([0.0, *1.0 / SETTLE])
    rate = np.broadcast_to(rate, vel.shape).reshape(num, -1)
    turn = np.stack([np.zeros(num), turn[row[:, 0], np.abs(turn).argmax(axis=1)]], axis=1)
    turn = np.repeat(turn, vel[0, 0].size, axis=1)
    pos, vel = last + share[..., 0].sum(axis=1), flat
    pos, vel = (np.stack([np.real(each), np.imag(each)], axis=-1) for each in (pos, vel))
    return pos, vel, rate, turn
