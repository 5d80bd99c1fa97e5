"""Filters that explain observations of targets in the plane by different hypotheses.

One Kalman filter runs for each hypothesis about a target. Bayes' rule weighs the hypotheses by
their likelihoods, so that the state of the target is a mixture of Gaussians. A hypothesis specifies
four things:

* The volatility s [1/sqrt(s)]: within a time t, the velocity on each axis changes by s sqrt(t)
  times the observed speed (standard deviation), and fades at the rate min(s^2 / 2, 0.05 / s). A
  target of small volatility keeps its velocity, and a target of large volatility manoeuvres. The
  random acceleration is correlated in time [Singer1970].
* A constant turn rate, which is usually zero.
* One change of the motion after an observation, or none. After the change the target stands, has
  another velocity, or manoeuvres.
* The noise of the observations, if the caller does not pass it.

Every observation may be an outlier. Its update is weighted by the probability that it is none. All
lengths are relative to the observed motion, so that results do not depend on the unit of length.
The filters run in float64 on the host. Points of the plane are complex numbers x + i y.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

VOLATILITY = np.array([0.01, 0.03, 0.1, 0.3, 1.0, 3.0])  # [1/sqrt(s)]
SETTLE = np.array([0.1, 0.4])  # [s], correlation times of the acceleration
_NOISE = (3.0, 1.0, 0.3, 0.1)  # standard deviations of the noise, relative to the estimate
# [rad/s], turn rates of targets that turn steadily during all observations
_TURNS = np.outer([-1.0, 1.0], np.geomspace(0.03, 0.4, 8)).ravel()
_STAND, _GO, _BUSY, _TURN = 1, 2, 3, 4  # changes: to standstill, another velocity, a manoeuvre
_CALM, _WILD = 1, 4  # indices into VOLATILITY: without a manoeuvre, and during one
_CHANGE, _TURNING = 0.1, 0.05  # prior probabilities of a change, and of a steady turn
# The motion may change between the observation this many before the last one, and the next one.
_BEFORE = np.array([*range(1, 11), 12, 14, 17, 20, 24, 28, 33, 39, 46, 54])
_OUTLIER = 0.005  # prior probability that an observation is an outlier
_KEPT = 48  # number of hypotheses in a mixture, the most probable ones
_LEAST = 1e-100  # [m, m/s], least noise and speed
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(6)


class Mixture(NamedTuple):
    """K hypotheses about each of N targets at its last observation; N = 1 without a batch."""

    is_known: np.ndarray  # (N,) bool, whether the observations determine a speed
    speed: np.ndarray  # (N, 1) [m/s], standard deviation of a component of the velocity
    chance: np.ndarray  # (N, K), probabilities; the sum of each row is 1
    volatility: np.ndarray  # (N, K), indices into the volatilities
    settle: np.ndarray  # (N, K), indices into the correlation times of the acceleration
    has_changed: np.ndarray  # (N, K) bool, whether the motion has changed, or turns
    turn: np.ndarray  # (N, K) [rad/s], constant turn rate
    end: np.ndarray  # (N, 1) [1/s], rate at which turns end after the last observation
    # (N, K, 3) complex [m, m/s, m/s^2], position relative to the last one, velocity, acceleration
    state: np.ndarray
    covariance: np.ndarray  # (N, K, 3, 3), Hermitian: half of the covariance of the complex state


class Fit(NamedTuple):
    """State, change of motion and noise of N targets, estimated from their observations."""

    mixture: Mixture
    chance_changed: np.ndarray  # (N,), probability that the motion changed
    since: np.ndarray  # (N,) [s], expected time of the change after the last observation, < 0
    noise: np.ndarray  # (N,) [m], standard deviation of an observed coordinate


def fit_bank(times: np.ndarray, places: np.ndarray, noise: float | None) -> Fit:
    """Run all filters over L observed positions of N targets.

    Args:
        times: (N, L) [s], ascending.
        places: (N, L) complex [m], observed positions.
        noise: [m], standard deviation of a coordinate of an observation; None to estimate it.
    """
    places = places - places[:, -1:]
    speed, spread, wide = _scales(times, places)
    if noise is not None:
        spread = np.full_like(spread, noise)
    among = _hypotheses(places.shape[1], _NOISE if noise is None else (1.0,))
    shape = (len(places), len(among.kind))
    settle, variance = SETTLE[among.settle], np.broadcast_to((spread * among.factor) ** 2, shape)
    level = VOLATILITY[among.volatility]
    state = np.zeros((*shape, 3), complex)
    state[..., 0] = places[:, :1]
    covariance = np.zeros((*shape, 3, 3), complex)
    covariance[..., 0, 0], covariance[..., 1, 1] = variance, speed**2
    covariance[..., 2, 2] = _acceleration(speed, level, settle) ** 2
    log_chance = np.broadcast_to(among.log_prior, shape)
    for i in range(1, places.shape[1]):
        step = times[:, i, None] - times[:, i - 1, None]
        if np.any(hit := among.change == i - 1):
            level = np.where(hit, VOLATILITY[among.later], level)
            _change(state, covariance, np.flatnonzero(hit), among.kind, speed, step)
            busy = hit & (among.kind == _BUSY)
            covariance[:, busy, 2, 2] = _acceleration(speed, level, settle)[:, busy] ** 2
        along = transition(step, level, settle, among.turn)
        state = np.einsum("nkij,nkj->nki", along, state)
        covariance = along @ covariance @ np.conj(np.swapaxes(along, -1, -2))
        covariance += diffusion(step, level, settle, speed, among.turn)
        off, total = places[:, i, None] - state[..., 0], np.real(covariance[..., 0, 0]) + variance
        square = np.abs(off) ** 2
        log_right = np.log1p(-_OUTLIER) - np.log(total) - 0.5 * square / total
        log_wrong = np.log(_OUTLIER) - 2.0 * np.log(wide) - 0.5 * square / wide**2
        log_both = np.logaddexp(log_right, log_wrong)
        right = np.exp(log_right - log_both)  # probability that the observation is no outlier
        log_chance = log_chance + log_both
        # Moments of the mixture of the updated state and the state without an update.
        gain = covariance[..., 0] / total[..., None]
        state = state + (right * off)[..., None] * gain
        kept = right * (total - 0.5 * (1.0 - right) * square)
        shrunk = gain[..., None] * np.conj(gain[..., None, :])
        covariance = covariance - kept[..., None, None] * shrunk
    chance = np.exp(log_chance - logsumexp(log_chance, axis=1, keepdims=True))
    changed = chance * (among.kind > 0)
    sum_changed = changed.sum(axis=1)
    when = 0.5 * (times[:, among.change] + times[:, among.change + 1]) - times[:, -1:]
    since = (changed * when).sum(axis=1) / np.where(sum_changed > 0.0, sum_changed, 1.0)
    # A turn that has lasted for all observations is expected to last as long again.
    span = times[:, -1:] - times[:, :1]
    end = np.divide(1.0, span, out=np.zeros_like(span), where=span > 0.0)
    best = np.argsort(-chance, axis=1, kind="stable")[:, :_KEPT]
    kept = best.shape[1]
    best = np.pad(best, ((0, 0), (0, _KEPT - kept)), mode="edge")
    row, known = np.arange(len(best))[:, None], span[:, 0] > 0.0
    best_chance = np.where(np.arange(_KEPT) < kept, chance[row, best], 0.0)
    best_chance = best_chance / best_chance.sum(axis=1, keepdims=True)
    indices = among.later[best], among.settle[best], among.kind[best] > 0, among.turn[best]
    last = state[row, best], covariance[row, best]
    mixture = Mixture(known, speed, best_chance, *indices, end, *last)
    return Fit(mixture, sum_changed, since, np.sqrt((chance * variance).sum(axis=1)))


def _change(
    state: np.ndarray,
    covariance: np.ndarray,
    hit: np.ndarray,
    kind: np.ndarray,
    speed: np.ndarray,
    step: np.ndarray,
) -> None:
    """Replace the velocity of the hypotheses `hit` that stand, or have another velocity.

    The change is at an unknown time within the step, which makes the position uncertain.
    """
    hit = hit[kind[hit] < _BUSY]
    variance = np.where(kind[hit] == _GO, speed**2, 0.0)
    unsure = (0.5 * np.abs(state[:, hit, 1]) ** 2 + variance) * step**2 / 6.0
    position = covariance[:, hit, 0, 0] + unsure
    state[:, hit, 1:] = 0.0
    covariance[:, hit] = 0.0
    covariance[:, hit, 0, 0], covariance[:, hit, 1, 1] = position, variance


class _Hypotheses(NamedTuple):
    """K hypotheses, in arrays (K,)."""

    volatility: np.ndarray  # index into VOLATILITY, before the change
    later: np.ndarray  # the same after the change
    settle: np.ndarray  # index into SETTLE
    factor: np.ndarray  # noise, relative to the estimate
    turn: np.ndarray  # [rad/s], constant turn rate
    kind: np.ndarray  # kind of the change, or 0
    change: np.ndarray  # index of the last observation before the change; -1 without a change
    log_prior: np.ndarray


def _hypotheses(num: int, factors: tuple[float, ...]) -> _Hypotheses:
    """List the hypotheses about a target with `num` observations."""
    changes = num - 1 - _BEFORE[num - 1 - _BEFORE >= 1]
    levels = range(len(VOLATILITY))
    # Kinds of changes, with the volatilities before and after the change. A sudden start is
    # distinguished from an outlier only if the calm motion before it is explained too.
    kinds = ((_STAND, _CALM, _CALM), (_GO, _CALM, _CALM), (_GO, 0, _CALM), (_BUSY, _CALM, _WILD))
    # Rows: volatility, later volatility, correlation time, turn rate, kind of change, change.
    steady = [(i, i, j, 0.0, 0, -1) for i in levels for j in range(len(SETTLE))]
    changing = [(*pair, 0, 0.0, kind, k) for kind, *pair in kinds for k in changes]
    turning = [(i, i, 0, turn, _TURN, 0) for i in (_CALM, _CALM + 1) for turn in _TURNS]
    parts = [(1.0 - _CHANGE - _TURNING, steady), (_CHANGE, changing), (_TURNING, turning)]
    if num < 3:
        parts = [(1.0, steady)]
    rows = [(*row, factor) for _, some in parts for row in some for factor in factors]
    prior = [share / len(some) for share, some in parts for _ in some for _ in factors]
    columns = np.array(rows).T
    level, later, settle, kind, change = columns[[0, 1, 2, 4, 5]].astype(int)
    return _Hypotheses(level, later, settle, columns[6], columns[3], kind, change, np.log(prior))


def _scales(times: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return speed [m/s], noise [m] and extent [m], each (N, 1), of observations (N, L)."""
    num = places.shape[1]
    middle = np.median(np.real(places), axis=1) + 1j * np.median(np.imag(places), axis=1)
    extent = np.maximum(np.abs(places - middle[:, None]).max(axis=1, keepdims=True), _LEAST)
    if num == 1:
        return extent, extent, extent
    smooth = places.copy()
    if num >= 5:  # medians of three drop single outliers
        three = np.stack([places[:, :-2], places[:, 1:-1], places[:, 2:]])
        smooth[:, 1:-1] = np.median(np.real(three), axis=0) + 1j * np.median(np.imag(three), axis=0)
    stride = max(num // 4, 1)
    gap = times[:, stride:] - times[:, :-stride]
    way = np.abs(smooth[:, stride:] - smooth[:, :-stride])
    speeds = np.divide(way, gap, out=np.zeros_like(way), where=gap > 0.0)
    speed = np.quantile(speeds, 0.9, axis=1)[:, None]
    span = times[:, -1:] - times[:, :1]
    least = 1e-3 * np.divide(extent, span, out=np.zeros_like(span), where=span > 0.0)
    if num == 2:
        noise = 0.1 * np.abs(places[:, 1:] - places[:, :1])
    else:
        gap = times[:, 2:] - times[:, :-2]
        share = np.full_like(gap, 0.5)
        share = np.divide(times[:, 1:-1] - times[:, :-2], gap, out=share, where=gap > 0.0)
        off = places[:, 1:-1] - (1.0 - share) * places[:, :-2] - share * places[:, 2:]
        square = np.abs(off) ** 2 / (1.0 + share**2 + (1.0 - share) ** 2)
        # The median of the squared length of a Gaussian vector in the plane is 2 log(2) variances.
        noise = np.sqrt(np.median(square, axis=1) / (2.0 * np.log(2.0)))[:, None]
    return (
        np.maximum(speed, np.maximum(least, _LEAST)),
        np.maximum(noise, 1e-4 * extent),
        extent,
    )


def _acceleration(speed: np.ndarray, volatility: np.ndarray, settle: np.ndarray) -> np.ndarray:
    """Return the standard deviation [m/s^2] of the random acceleration on each axis."""
    return speed * volatility / np.sqrt(2.0 * settle)


def fading(volatility: np.ndarray) -> np.ndarray:
    """Return the rate [1/s] at which the velocity fades, bounded since a manoeuvre is no stop."""
    return np.minimum(0.5 * volatility**2, 0.05)


def transition(
    time: np.ndarray, volatility: np.ndarray, settle: np.ndarray, turn: np.ndarray
) -> np.ndarray:
    """Return matrices (..., 3, 3) that move position, velocity and acceleration on by a time [s].

    The velocity turns, and fades. The acceleration turns with the velocity, and decays within
    `settle`.
    """
    decay = fading(volatility) - 1j * turn + 0.0 * time
    slow, fast = _reach(decay, time), _reach(decay + 1.0 / settle, time)
    left, quick = np.exp(-decay * time), np.exp(-time / settle)
    along = np.zeros((*decay.shape, 3, 3), complex)
    along[..., 0, 0], along[..., 0, 1], along[..., 0, 2] = 1.0, slow, (slow - fast) * settle
    along[..., 1, 1], along[..., 1, 2] = left, left * (1.0 - quick) * settle
    along[..., 2, 2] = left * quick
    return along


def diffusion(
    time: np.ndarray,
    volatility: np.ndarray,
    settle: np.ndarray,
    speed: np.ndarray,
    turn: np.ndarray,
) -> np.ndarray:
    """Return the covariances (..., 3, 3) that the random acceleration adds within a time [s]."""
    density = 2.0 * _acceleration(speed, volatility, settle) ** 2 / settle
    total = 0.0
    for node, weight in zip(0.5 + 0.5 * _NODE, 0.5 * _WEIGHT, strict=True):
        one = transition(node * time, volatility, settle, turn)[..., 2]
        share = (weight * time * density)[..., None, None]
        total = total + share * one[..., None] * np.conj(one[..., None, :])
    return np.asarray(total)


def _reach(rate: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return the integrals of exp(-rate t) from 0 to a time."""
    angle = rate * time
    small = np.abs(angle) < 1e-9
    return time * np.where(small, 1.0, -np.expm1(-angle) / np.where(small, 1.0, angle))
