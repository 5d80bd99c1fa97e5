"""When and in what order to catch: by estimated arrival, or the best of all orders.

The estimate sees a point that accelerates evenly to its greatest speed, and a target that may
be caught while it is high enough and does not come from below. It serves to rank orders and to
guess times; the planner then optimises the times together with the trajectory.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.protocol import Status, is_unsolved
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.plan import CatchPlan

_GRID = 64  # times at which every target is looked at
_ACCELERATION = 7.0  # [m/s^2], sustained, of the estimate
_TURNING = 0.2  # [s] to begin to move
_STEEPEST = -0.2  # least upward part of the way back along the target's path


@struct.dataclass
class _Timetable:
    """Where every target is, when, and whether it may be caught there."""

    times: Array  # (N, K) [s]
    places: Array  # (N, K, 3) [m], of the quadrotor
    penalty: Array  # (N, K) [m], above zero where a catch is hardly possible


def _sampled(case: CatchCase) -> tuple[Array, BallState, Array]:
    """Times (N, K) up to the horizon, the targets' states and their speeds (N, K) then."""
    shares = jnp.asarray(np.arange(1, _GRID + 1) / _GRID, case.gravity.dtype)
    times = case.horizon[:, None] * shares
    states = jax.vmap(lambda target, at: jax.vmap(target.at)(at))(case.targets, times)
    speed = jnp.sqrt(jnp.maximum(jnp.sum(states.vel**2, axis=-1), 1e-6))
    return times, states, speed


def _timetable(case: CatchCase) -> _Timetable:
    net, limits = case.net, case.limits
    times, states, speed = _sampled(case)
    up = jnp.array([0.0, 0.0, 1.0], times.dtype)
    from_below = jnp.maximum(states.vel[..., 2] / speed + _STEEPEST, 0.0)
    places = states.pos - net.height * up
    low = jnp.maximum(limits.min_height + 0.1 - places[..., 2], 0.0)
    return _Timetable(times=times, places=places, penalty=10.0 * from_below + 10.0 * low)


def _arrival(
    table: _Timetable, target: Array, begin: Array, place: Array, speed: Array
) -> tuple[Array, Array, Array]:
    """Earliest time (), place (3,) and shortfall () of the next catch."""
    times, places, penalty = table.times[target], table.places[target], table.penalty[target]
    distance = jnp.sqrt(jnp.maximum(jnp.sum((places - place) ** 2, axis=-1), 1e-12))
    span = jnp.maximum(times - begin - _TURNING, 0.0)
    rise = speed / _ACCELERATION
    reach = jnp.where(span < rise, 0.5 * _ACCELERATION * span**2, speed * span - 0.5 * speed * rise)
    late = jnp.where(times > begin, 0.0, 100.0)
    shortfall = jnp.maximum(distance - reach, 0.0) + penalty + late
    possible = shortfall <= 0.0
    first = jnp.where(jnp.any(possible), jnp.argmax(possible), jnp.argmin(shortfall))
    return times[first], places[first], shortfall[first]


def _follow(case: CatchCase, table: _Timetable, order: Array) -> tuple[CatchChoice, Array]:
    """Estimated times of one order (N,), present targets moved to the front.

    Also by how much () [m] the targets stay out of the estimate's reach.
    """
    order = order[jnp.argsort(~case.present[order], stable=True)]
    speed = 0.9 * case.limits.speed

    def advance(state: tuple, target: Array) -> tuple[tuple, tuple[Array, Array]]:
        begin, place = state
        time, there, shortfall = _arrival(table, target, begin, place, speed)
        here = case.present[target]
        time = jnp.where(here, jnp.maximum(time, begin + 0.05), begin + 0.05)
        there = jnp.where(here, there, place)
        return (time, there), (time, jnp.where(here, shortfall, 0.0))

    start = (jnp.zeros_like(case.gravity), case.head_state[0])
    _, (times, shortfalls) = jax.lax.scan(advance, start, order)
    return CatchChoice(order=order, times=times), jnp.sum(shortfalls)


def closest_approach(cases: CatchCase) -> Array:
    """How near each target comes to where the net could be, (N,) [m]; zero is within reach.

    A bound that no plan can beat, at 64 times up to the horizon: the quadrotor leaves with its
    velocity and flies at its greatest speed in any direction, above the least height.

    Args:
        cases: one case, or a batch, for which it is (B, N).
    """
    return _closest_approach(cases) if cases.batch_shape == () else _closest_approaches(cases)


def _closest_approach(case: CatchCase) -> Array:
    """`closest_approach` of one case."""
    net, limits = case.net, case.limits
    times, states, speed = _sampled(case)
    offset = states.pos - case.head_state[0]
    distance = jnp.sqrt(jnp.maximum(jnp.sum(offset**2, axis=-1), 1e-12))
    # The target moves on between two of the times.
    slack = net.height + net.radius + (speed + limits.speed) * case.horizon[:, None] / _GRID
    far = distance - limits.speed * times - slack
    low = limits.min_height - states.pos[..., 2] - slack
    gap = jnp.min(jnp.maximum(jnp.maximum(far, low), 0.0), axis=1)
    return jnp.where(case.present, gap, 0.0)


_closest_approaches = jax.jit(jax.vmap(_closest_approach))


def optimal_time_ratio(cases: CatchCase, plans: CatchPlan) -> np.ndarray:
    """Mean of |T_o - T_p| / T_o over the targets of every case, (B,) (paper 000, eq. 29).

    Args:
        cases: a batch.
        plans: of them, with the times T_p that were decided and the optimised ones T_o.
    """
    decided_times, optimised = np.asarray(plans.decided_times), np.asarray(plans.times)
    present = np.take_along_axis(np.asarray(cases.present), np.asarray(plans.order), axis=1)
    with np.errstate(all="ignore"):
        ratio = np.where(present, np.abs(optimised - decided_times) / optimised, 0.0)
        return ratio.sum(axis=1) / present.sum(axis=1)


class CatchDecision:
    """What the decisions about catches have in common."""

    def check(self, cases: CatchCase) -> None:
        """Any batch will do."""

    def rank(self, plans: CatchPlan) -> Array:
        """The time of the last catch [s], one a plan."""
        return plans.times[..., -1]

    def explain(self, case: CatchCase, status: Array) -> Array:
        """OUT_OF_REACH for an unsolved case with a target that `closest_approach` rules out."""
        away = jnp.max(_closest_approach(case)) > 0.0
        return jnp.where(is_unsolved(status) & away, jnp.int32(Status.OUT_OF_REACH), status)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Best(CatchDecision):
    """The most promising of all orders are planned, and the earliest last catch is kept.

    All N! orders are estimated. Those with the least shortfall, then the earliest last catch,
    are the finalists.
    """

    finalists: int = 6  # orders that are planned

    def __post_init__(self) -> None:
        if self.finalists < 1:
            raise ValueError(f"finalists must be >= 1, got {self.finalists}")

    def propose(self, case: CatchCase) -> CatchChoice:
        """The finalists of one case, leaves (F, N)."""
        orders = jnp.asarray(list(itertools.permutations(range(case.num_targets))), jnp.int32)
        table = _timetable(case)
        choices, shortfall = jax.vmap(functools.partial(_follow, case, table))(orders)
        rank = choices.times[:, -1] + 10.0 * shortfall
        chosen = jnp.argsort(rank)[: min(self.finalists, len(orders))]
        return jax.tree.map(lambda leaf: leaf[chosen], choices)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Greedy(CatchDecision):
    """Next is caught whatever can be caught earliest."""

    def propose(self, case: CatchCase) -> CatchChoice:
        """The one choice for one case, leaves (1, N)."""
        table = _timetable(case)
        num, speed = case.num_targets, 0.9 * case.limits.speed
        begin, place = jnp.zeros_like(case.gravity), case.head_state[0]
        left, order = jnp.ones(num, bool), []
        for _ in range(num):
            arrive = lambda target, t=begin, p=place: _arrival(table, target, t, p, speed)  # noqa: E731
            times, places, shortfalls = jax.vmap(arrive)(jnp.arange(num))
            # Absent targets come last, in any order.
            rank = jnp.where(case.present, times + 10.0 * shortfalls, 1e9)
            target = jnp.argmin(jnp.where(left, rank, jnp.inf))
            here = case.present[target]
            begin = jnp.where(here, jnp.maximum(times[target], begin + 0.05), begin)
            place = jnp.where(here, places[target], place)
            left = left & (jnp.arange(num) != target)
            order.append(target)
        choice, _ = _follow(case, table, jnp.stack(order).astype(jnp.int32))
        return jax.tree.map(lambda leaf: leaf[None], choice)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Given(CatchDecision):
    """Order and times are those that the cases hold."""

    def check(self, cases: CatchCase) -> None:
        """Raise `ValueError` unless every order is a permutation."""
        order = np.asarray(cases.order)
        wrong = np.flatnonzero((np.sort(order, axis=-1) != np.arange(order.shape[-1])).any(axis=-1))
        if wrong.size:
            raise ValueError(
                f"order must be a permutation of 0..{order.shape[-1] - 1}, "
                f"got {order[wrong[0]].tolist()} in case {wrong[0]}"
            )

    def propose(self, case: CatchCase) -> CatchChoice:
        """The one choice of one case, leaves (1, N)."""
        return CatchChoice(order=case.order[None], times=case.times[None])
