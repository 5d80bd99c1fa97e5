"""Estimates of when the quadrotor can catch targets, for decisions on the order of catches.

The quadrotor is modelled as a point that accelerates at a constant rate up to its greatest speed. A
target can be caught where it is high enough and does not rise too steeply. The estimated times are
first guesses, which the planner optimises together with the trajectory.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import state_at
from planner_jax.lanes import over_lanes
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.context import targets_at

GRID = 64  # number of times up to its horizon at which every target is sampled
INSTANT = 0.05  # [s], least time between two catches
_ACCELERATION = 7.0  # [m/s^2], of the point that models the quadrotor
_TURNING = 0.2  # [s], time to tilt before the point starts to move
_STEEPEST = 0.2  # greatest sine of a target's angle of ascent at a catch
# [m], distance by which the estimated flight may miss an optional target that is still tried: plans
# reach farther than the estimate.
MARGIN = 0.8


@struct.dataclass
class Timetable:
    """Possible catches of one target at K times; for N targets, leaves have a leading axis N."""

    times: Array  # (K,) [s], of the catches
    places: Array  # (3, K) [m], positions of the quadrotor at the catches
    penalty: Array  # (K,) [m], positive where the target is too low or rises too steeply


def sample_targets(case: CatchCase) -> tuple[Array, BallState, Array]:
    """Sample N targets at K times: times (N, K) [s], states (N, 3, K), speeds (N, K) [m/s]."""
    shares = jnp.asarray(np.arange(1, GRID + 1) / GRID, case.gravity.dtype)
    times = case.horizon[:, None] * shares[None]
    along = lambda target, at: over_lanes(functools.partial(state_at, target))(at)  # noqa: E731
    states = jax.vmap(along)(case.targets, times)
    return times, states, length(states.vel)


def timetable(case: CatchCase) -> Timetable:
    """Return the possible catches of the N targets of one case, at K times for each target."""
    times, states, speed = sample_targets(case)
    places, penalty = _to_catch(case, states, speed)
    return Timetable(times=times, places=places, penalty=penalty)


def _to_catch(case: CatchCase, states: BallState, speed: Array) -> tuple[Array, Array]:
    net, limits = case.net, case.limits
    from_below = jnp.maximum(states.vel[:, 2] / speed - _STEEPEST, 0.0)
    places = states.pos - net.height * jnp.asarray([[[0.0], [0.0], [1.0]]], states.pos.dtype)
    low = jnp.maximum(limits.min_height + 0.1 - places[:, 2], 0.0)
    return places, 10.0 * from_below + 10.0 * low


def length(vectors: Array) -> Array:
    """Return the Euclidean norms (..., K) of K vectors (..., 3, K), but at least 1e-6."""
    x, y, z = vectors[..., 0, :], vectors[..., 1, :], vectors[..., 2, :]
    return jnp.sqrt(jnp.maximum(x * x + y * y + z * z, 1e-12))


def arrival(
    table: Timetable, begin: Array, place: Array, speed: Array, haste: Array | float = 1.0
) -> tuple[Array, Array, Array]:
    """Return time () [s], position (3,) [m] and shortfall () [m] of a target's earliest catch.

    The quadrotor leaves the position `place` (3,) [m] at `begin` () [s]; `speed` () [m/s] is its
    greatest speed. It tilts `haste` times as fast, and accelerates `haste`^2 times as much, as in
    cautious estimates. The shortfall is 0 if a catch is possible. Else it is the distance by which
    the quadrotor misses the target, plus a penalty [m] if the target is too low or rises too
    steeply, at the time at which this sum is least.
    """
    times, places, penalty = table.times, table.places, table.penalty
    late = jnp.where(times > begin, 0.0, 100.0)
    short = _out_of_reach(places - place[:, None], times - begin, speed, haste) + penalty + late
    # Index of the first time at which a catch is possible, else of the least shortfall.
    first = jnp.argmin(jnp.where(short <= 0.0, np.arange(-short.size, 0.0), short))
    return times[first], places[:, first], short[first]


arrivals = jax.vmap(arrival, (0, None, None, None))  # `arrival` for N targets from one position


def _out_of_reach(offset: Array, span: Array, speed: Array, haste: Array | float = 1.0) -> Array:
    span, acc = jnp.maximum(span - _TURNING / haste, 0.0), _ACCELERATION * haste**2
    rise = speed / acc
    reach = jnp.where(span < rise, 0.5 * acc * span**2, speed * span - 0.5 * speed * rise)
    return jnp.maximum(length(offset) - reach, 0.0)


def shortfall(case: CatchCase, choice: CatchChoice) -> Array:
    """Return the sum () [m] of distances by which the quadrotor misses the chosen targets."""
    order, times = choice.order, choice.times
    targets = jax.tree.map(lambda leaf: leaf[order], case.targets)
    states = jax.tree.map(lambda leaf: leaf[..., None], targets_at(targets, times))
    places, penalty = _to_catch(case, states, length(states.vel))
    before = jnp.concatenate([case.head_state[None, :1].mT, places[:-1]])
    span = jnp.diff(times, prepend=jnp.zeros_like(times[:1]))
    short = _out_of_reach(places - before, span[:, None], top_speed(case)) + penalty
    short = (jnp.maximum(short - MARGIN, 0.0) if case.optional else short)[:, 0]
    return jnp.sum(jnp.where(case.present[order], short, 0.0))


def follow(case: CatchCase, table: Timetable, order: Array) -> tuple[CatchChoice, Array]:
    """Return an order of N targets with its earliest times of catches, and the shortfall () [m].

    The shortfall is the sum of distances by which the quadrotor misses its targets. Absent targets
    are moved to the end of the order.
    """
    order = order[jnp.argsort(~case.present[order], stable=True)]

    def advance(state: tuple, target: Array) -> tuple[tuple, tuple[Array, Array]]:
        begin, place = state
        own = jax.tree.map(lambda leaf: leaf[target], table)
        *catch, short = arrival(own, begin, place, top_speed(case))
        time, there = _leave_from(case.present[target], begin, place, *catch)
        return (time, there), (time, jnp.where(case.present[target], short, 0.0))

    start = (jnp.zeros_like(case.gravity), case.head_state[0])
    _, (times, shortfalls) = jax.lax.scan(advance, start, order)
    return CatchChoice(order=order, times=times, taken=case.present), jnp.sum(shortfalls)


def earliest_next(case: CatchCase, table: Timetable, handicap: Array) -> CatchChoice:
    """Return the order in which the next target is always the target with the earliest catch.

    Before the times are compared, `handicap` (N,) [s] is added to the times of N targets, which
    makes other orders possible. Optional targets out of reach, and absent targets, come last.
    """
    speed = top_speed(case)

    def advance(state: tuple, _: None) -> tuple[tuple, tuple[Array, Array, Array]]:
        begin, place, left = state
        times, places, shortfalls = arrivals(table, begin, place, speed)
        possible = can_be_next(case, shortfalls)
        rank = jnp.where(possible, later_by_shortfall(times, shortfalls) + handicap, 1e9)
        target = jnp.argmin(jnp.where(left, rank, jnp.inf)).astype(jnp.int32)
        taken = possible[target]
        time, there = _leave_from(taken, begin, place, times[target], places[target])
        return (time, there, left.at[target].set(False)), (target, time, taken)

    start = (jnp.zeros_like(case.gravity), case.head_state[0], jnp.ones(case.num_targets, bool))
    _, (order, times, taken) = jax.lax.scan(advance, start, length=case.num_targets)
    return CatchChoice(order=order, times=times, taken=jnp.zeros_like(taken).at[order].set(taken))


def later_by_shortfall(times: Array, shortfalls: Array) -> Array:
    """Return the ranks of catches: time plus 10 s for each metre of miss; the least is best."""
    return times + 10.0 * shortfalls


def can_be_next(case: CatchCase, shortfalls: Array, margin: float = MARGIN) -> Array:
    """Return which of N targets may be caught next, (N,) bool.

    These are all targets that are present. Optional targets must also be within reach: estimates
    of the distances `shortfalls` (N,) [m] by which they are missed must be at most `margin` [m].
    """
    return case.present & (shortfalls <= margin) if case.optional else case.present


def top_speed(case: CatchCase, haste: Array | float = 1.0) -> Array:
    """Return the greatest speed () [m/s] in estimates: 0.9 `haste` times the limit, at most it."""
    return jnp.minimum(0.9 * haste, 1.0) * case.limits.speed


def _leave_from(
    taken: Array, begin: Array, place: Array, time: Array, there: Array
) -> tuple[Array, Array]:
    soonest = begin + INSTANT
    return jnp.where(taken, jnp.maximum(time, soonest), soonest), jnp.where(taken, there, place)
