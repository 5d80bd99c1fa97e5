"""When targets can be caught, by a rough estimate of what the quadrotor can reach.

The estimate sees a point that accelerates evenly to its greatest speed, and a target that may
be caught while it is high enough and does not come from below. It serves to rank orders and to
guess times; the planner then optimises the times together with the trajectory.
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

GRID = 64  # times at which every target is looked at
_ACCELERATION = 7.0  # [m/s^2], sustained, of the estimate
_TURNING = 0.2  # [s] to begin to move
INSTANT = 0.05  # [s], between two catches at least
_STEEPEST = -0.2  # least upward part of the way back along the target's path
# [m], by which an optional target may be out of the estimate's reach and is still tried: plans go
# a little farther than the estimate.
_TRIED = 0.8


@struct.dataclass
class Timetable:
    """Where a target is, when, and whether it may be caught there; one, or N with an axis more."""

    times: Array  # (K,) [s]
    places: Array  # (3, K) [m], of the quadrotor
    penalty: Array  # (K,) [m], above zero where a catch is hardly possible


def sampled(case: CatchCase) -> tuple[Array, BallState, Array]:
    """Times (N, K) up to the horizon, the targets' states (N, 3, K) and speeds (N, K) then.

    The times come last: a CPU computes with many of them at once.
    """
    shares = jnp.asarray(np.arange(1, GRID + 1) / GRID, case.gravity.dtype)
    times = case.horizon[:, None] * shares
    along = lambda target, at: over_lanes(functools.partial(state_at, target))(at)  # noqa: E731
    states = jax.vmap(along)(case.targets, times)
    return times, states, length(states.vel)


def timetable(case: CatchCase) -> Timetable:
    """When and where each of the N targets of one case may be caught."""
    times, states, speed = sampled(case)
    places, penalty = _to_catch(case, states, speed)
    return Timetable(times=times, places=places, penalty=penalty)


def _to_catch(case: CatchCase, states: BallState, speed: Array) -> tuple[Array, Array]:
    """Return where the quadrotor catches N targets (N, 3, K), and the penalty (N, K) [m] there."""
    net, limits = case.net, case.limits
    from_below = jnp.maximum(states.vel[:, 2] / speed + _STEEPEST, 0.0)
    places = states.pos - net.height * jnp.asarray([[0.0], [0.0], [1.0]], states.pos.dtype)
    low = jnp.maximum(limits.min_height + 0.1 - places[:, 2], 0.0)
    return places, 10.0 * from_below + 10.0 * low


def length(vectors: Array) -> Array:
    """Lengths (..., K) of vectors (..., 3, K), never zero."""
    x, y, z = vectors[..., 0, :], vectors[..., 1, :], vectors[..., 2, :]
    return jnp.sqrt(jnp.maximum(x * x + y * y + z * z, 1e-12))


def arrival(
    table: Timetable, begin: Array, place: Array, speed: Array
) -> tuple[Array, Array, Array]:
    """Return the earliest time () [s], place (3,) and shortfall () [m] of the catch of one target.

    The quadrotor leaves a place (3,) [m] at `begin` () [s], with a greatest speed () [m/s].
    """
    times, places, penalty = table.times, table.places, table.penalty
    late = jnp.where(times > begin, 0.0, 100.0)
    short = _out_of_reach(places - place[:, None], times - begin, speed) + penalty + late
    # The first time at which nothing is short, or else that at which least is.
    first = jnp.argmin(jnp.where(short <= 0.0, np.arange(-short.size, 0.0), short))
    return times[first], places[:, first], short[first]


# The same of N targets, whose timetable has an axis more.
arrivals = jax.vmap(arrival, (0, None, None, None))


def _out_of_reach(way: Array, span: Array, speed: Array) -> Array:
    """By how much (..., K) [m] ways (..., 3, K) are longer than what is flown in spans [s]."""
    span = jnp.maximum(span - _TURNING, 0.0)
    rise = speed / _ACCELERATION
    reach = jnp.where(span < rise, 0.5 * _ACCELERATION * span**2, speed * span - 0.5 * speed * rise)
    return jnp.maximum(length(way) - reach, 0.0)


def shortfall(case: CatchCase, choice: CatchChoice) -> Array:
    """How far () [m], all in all, targets are out of the estimate's reach at chosen times.

    The case is one as it was decided: what it leaves does not count, and neither does, of optional
    targets, what is tried even so.
    """
    order, times = choice.order, choice.times
    targets = jax.tree.map(lambda leaf: leaf[order], case.targets)
    states = jax.tree.map(lambda leaf: leaf[..., None], targets_at(targets, times))
    places, penalty = _to_catch(case, states, length(states.vel))
    before = jnp.concatenate([case.head_state[None, :1].mT, places[:-1]])
    span = jnp.diff(times, prepend=jnp.zeros_like(times[:1]))
    short = _out_of_reach(places - before, span[:, None], top_speed(case)) + penalty
    short = (jnp.maximum(short - _TRIED, 0.0) if case.optional else short)[:, 0]
    return jnp.sum(jnp.where(case.present[order], short, 0.0))


def follow(case: CatchCase, table: Timetable, order: Array) -> tuple[CatchChoice, Array]:
    """Estimated times of one order (N,), present targets moved to the front.

    Also by how much () [m] the targets stay out of the estimate's reach.
    """
    order = order[jnp.argsort(~case.present[order], stable=True)]

    def advance(state: tuple, target: Array) -> tuple[tuple, tuple[Array, Array]]:
        begin, place = state
        own = jax.tree.map(lambda leaf: leaf[target], table)
        found = arrival(own, begin, place, top_speed(case))
        time, there = _caught(case.present[target], begin, place, *found[:2])
        return (time, there), (time, jnp.where(case.present[target], found[2], 0.0))

    start = (jnp.zeros_like(case.gravity), case.head_state[0])
    _, (times, shortfalls) = jax.lax.scan(advance, start, order)
    return CatchChoice(order=order, times=times, taken=case.present), jnp.sum(shortfalls)


def earliest_next(case: CatchCase, table: Timetable, handicap: Array) -> CatchChoice:
    """Return the choice that next catches the target that can be caught earliest; absent ones last.

    Optional targets that can no longer be reached are left, and come last too. Each target is taken
    to be caught later by a handicap (N,) [s].
    """
    speed = top_speed(case)

    def advance(state: tuple, _: None) -> tuple[tuple, tuple[Array, Array, Array]]:
        begin, place, left = state
        times, places, shortfalls = arrivals(table, begin, place, speed)
        possible = takeable(case, shortfalls)
        rank = jnp.where(possible, later_by_shortfall(times, shortfalls) + handicap, 1e9)
        target = jnp.argmin(jnp.where(left, rank, jnp.inf)).astype(jnp.int32)
        here = possible[target]
        time, there = _caught(here, begin, place, times[target], places[target])
        return (time, there, left.at[target].set(False)), (target, time, here)

    start = (jnp.zeros_like(case.gravity), case.head_state[0], jnp.ones(case.num_targets, bool))
    _, (order, times, here) = jax.lax.scan(advance, start, length=case.num_targets)
    return CatchChoice(order=order, times=times, taken=jnp.zeros_like(here).at[order].set(here))


def later_by_shortfall(times: Array, shortfalls: Array) -> Array:
    """Times [s] by which catches are ranked: what is out of reach [m] counts as late."""
    return times + 10.0 * shortfalls


def takeable(case: CatchCase, shortfalls: Array) -> Array:
    """Which targets (N,) may be the next, of which `arrivals` tells the shortfalls (N,) [m]."""
    return case.present & (shortfalls <= _TRIED) if case.optional else case.present


def top_speed(case: CatchCase) -> Array:
    """The greatest speed () [m/s] of the estimate."""
    return 0.9 * case.limits.speed


def _caught(
    here: Array, begin: Array, place: Array, time: Array, there: Array
) -> tuple[Array, Array]:
    """When () [s] and where (3,) the quadrotor goes on; an absent target takes but an instant."""
    soonest = begin + INSTANT
    return jnp.where(here, jnp.maximum(time, soonest), soonest), jnp.where(here, there, place)
