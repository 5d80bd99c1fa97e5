"""Compiled programs of `pj.ball.fit`: the estimate of a flight, and its prediction.

The docstring of `planner_jax.ball.recording` lists the unknowns.
"""

import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.ball.spin import SpinningBall, Surroundings, spin_acceleration, spin_flight
from planner_jax.core.arithmetic import at_least
from planner_jax.core.compiled import QUICK_OPTIONS

_UNKNOWNS, _BEFORE = 15, 12  # numbers of unknowns, and of those with an effect before a bounce
ArrayT = TypeVar("ArrayT", Array, np.ndarray)
_OTHERS = 10  # number of further results of `estimate`
_DRIFT = 4.0  # standard deviation of the drift of stamps, divided by the spread of their delays
_TAIL = 4.0  # degrees of freedom of Student's t distribution of the errors
WEIGHT = 4.0  # number of observations that the assumed noise counts for
_ROUNDS = (2, 4)  # numbers of linearisations of a short flight without bounce, and of others
_WEIGHINGS = 3  # number of weighted least-squares problems for each linearisation
# Each row selects a pair of observations, from which a first guess of the flight is made. A row has
# the time of the first observation, and the time from there to the second one, as fractions of the
# recording's duration. The fractions are quasi-random numbers.
_PAIRS = 0.6 * (np.arange(1, 17)[:, None] * [0.618034, 0.754878] % 1.0)
# Numbers of Runge-Kutta steps of a flight, and greatest products of drag and distance for them.
_STEPS = ((2, 0.25), (4, 1.0), (12, 3.0), (48, 12.0))
MOST_EXPONENT = _STEPS[-1][1]  # greatest product of drag and distance of a prediction
_BELOW = 0.002  # [m], distance below the floor from which a predicted ball has fallen through it
_FAR = 25.0  # squared distance, in standard deviations, from which an observation is an outlier
_MOST_OUTLIERS = 0.45  # greatest share of outliers of a recording
_MOST_NOISE = 0.1  # greatest error of an observation along the path, as a share of its extent
_MOST_LIFT = 8.0  # greatest length of the lift vector, in standard deviations


def unpack(fitted: ArrayT) -> tuple[ArrayT, ArrayT, ArrayT]:
    """Return the state, its covariance, and the other numbers of results of `estimate`."""
    square = fitted[..., _UNKNOWNS:-_OTHERS].reshape((*fitted.shape[:-1], _UNKNOWNS, _UNKNOWNS))
    return fitted[..., :_UNKNOWNS], square, fitted[..., -_OTHERS:]


def next_size(num: int, least: int = 16) -> int:
    """Return the least power of two that is at least `num` and `least`."""
    return max(least, 1 << (num - 1).bit_length())


def num_steps(exponent: float) -> int:
    """Return the number of steps of flights with this product of drag and distance."""
    return next((steps for steps, most in _STEPS if exponent <= most), _STEPS[-1][0])


@functools.cache
def compile_program(function: Callable, bounces: int, steps: int) -> Callable:
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


def _linearise(num: int, state: Array, *others: PyTree) -> tuple[Array, tuple[Array, Array]]:
    """Return slopes (N, 3, num) by the first `num` unknowns, with positions and velocities."""
    whole = functools.partial(jnp.append, values=state[num:])
    return jax.jacfwd(lambda x: _positions(whole(x), *others), has_aux=True)(state[:num])


def estimate(rows: Array, floor: Array, numbers: Array, counts: tuple[int, int]) -> Array:
    """Estimate one flight from rows (N, 4) of time [s] and position [m]; absent rows are NaN.

    The result has the unknowns, their covariance, squared errors of positions and of time
    stamps, last time, floor, share of outliers, and a verdict. It is 1 if the flight explains the
    rows; otherwise it is -1 if errors of neighbours are alike, and 0 if not. The last numbers are
    the length of the lift vector in standard deviations, the number of independent errors per
    error, the log likelihood of the rows, and the log of the prior probability of the unknowns.
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
            # Log likelihood of the rows, and volume of the unknowns (Laplace's method).
            squares = jnp.sum(left * left, axis=1) / (weight * overlap)
            each = 0.5 * (_TAIL + 3.0) * jnp.log1p(squares / _TAIL) + 0.5 * jnp.log(variance)
            each = jnp.where(present, each + jnp.log(scales[0]), 0.0)
            fits = -jnp.sum(each) - 0.5 * WEIGHT * (jnp.log(scales[0]) + noise**2 / scales[0])
            volume = jnp.sum(jnp.log(unit)) - jnp.sum(jnp.log(jnp.diag(factor[0])))
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
            across, variance = (sums / overlap + WEIGHT * noise**2) / (
                jnp.maximum(nums, 1.0) + WEIGHT
            )
            scales = jnp.stack([across, jnp.maximum(variance - across, 0.0) / mean_squared])
            far = jnp.sum(present & (distance > _FAR), dtype=num.dtype) / num
            return (change, scales, (1.0 - alike) / (1.0 + alike)), (covariance, far, fits, volume)

        begun = (jnp.zeros_like(state[:free]), *weights)
        (change, *weights), found = lax.scan(weigh, begun, None, length=_WEIGHINGS)
        return (state.at[:free].add(change), *weights), jax.tree.map(lambda leaf: leaf[-1], found)

    scales = jnp.stack([jnp.maximum(0.6 * error, noise**2), jnp.zeros_like(noise)])
    begun = state, scales, jnp.ones_like(noise)
    (state, scales, overlap), (covariance, far, fits, volume) = lax.scan(
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
    known = (state - jnp.concatenate([jnp.zeros(6), means])).at[:6].set(0.0)[:free]
    likely = volume[-1] - 0.5 * known @ prior @ known - jnp.sum(jnp.log(spreads))
    scales = scales.at[1].add(state[10] ** 2 * delay)
    results = jnp.stack(
        [*scales, last, floor, far[-1], verdict, size, overlap, fits[-1], likely]
    ).astype(rows.dtype)
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


def forecast(fitted: Array, times: Array, numbers: Array, counts: tuple[int, int]) -> Array:
    """Predict one flight at times (T,) after a result of `estimate`.

    The result (T, 24) has positions, velocities, and covariances of true and observed positions.
    They are NaN once the ball is below the floor, as it comes there after its simulated bounces.
    """
    state, covariance, (*scales, span, floor, _, _, _, _, _, _) = unpack(fitted)
    num = _UNKNOWNS if counts[0] else _BEFORE
    stamps = jnp.zeros((3, *times.shape)).at[0].set(times)
    slopes, (pos, vel) = _linearise(num, state, stamps, numbers, floor, counts)
    sure = jnp.einsum("nik,kl,njl->nij", slopes, covariance[:num, :num], slopes)
    after = jnp.maximum(times - 0.5 * span, 0.0)
    eye = jnp.eye(3, dtype=pos.dtype)[None]
    sure = sure + (numbers[12] * after**3 / 3.0)[:, None, None] * eye
    stamps = scales[1] * jnp.einsum("ni,nj->nij", vel, vel)
    seen = sure + scales[0] * eye + stamps
    found = jnp.concatenate([pos, vel, sure.reshape(-1, 9), seen.reshape(-1, 9)], axis=1)
    is_below = (counts[0] > 0) & (times > span) & (pos[:, 2] < floor - _BELOW)
    return jnp.where(is_below[:, None], jnp.nan, found)
