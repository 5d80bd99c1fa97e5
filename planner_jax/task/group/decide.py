"""Decisions about the order in which a car meets the targets of a group.

Orders are ranked by the estimated time of their last meeting; meetings for which the car would be
too late add to the rank. The estimate ignores obstacles: the car turns towards the next meeting
point and then drives straight to it. Motions are planned only for the orders of least rank.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.choices import require
from planner_jax.core.decision import Decision
from planner_jax.core.protocol import require_settings
from planner_jax.task.decisions import require_orders
from planner_jax.task.group.case import GroupChoice, InterceptGroup
from planner_jax.task.group.order import Departure, improve, make_table
from planner_jax.task.group.spec import MOST_PERMUTED

_GRID = 128  # number of times at which the position of every target is evaluated
_PACE = 0.8  # assumed mean speed of the car, divided by its greatest speed
_TURNING = 0.6  # assumed mean turn rate of the car, divided by its greatest turn rate


@struct.dataclass
class _Meeting:
    time: Array  # () [s], of the meeting
    position: Array  # (2,) [m], of the target and of the middle of the car's body
    heading: Array  # () [rad], of the car
    delay: Array  # () [s], sum over the meetings so far of the times by which the car is too late


def _start(group: InterceptGroup) -> _Meeting:
    shared = group.shared
    zero, position = jnp.zeros_like(shared.time), shared.body.middle_at(shared.start)
    return _Meeting(time=zero, position=position, heading=shared.start[2], delay=zero)


def _timetable(group: InterceptGroup) -> tuple[Array, Array]:
    shares = jnp.asarray(np.arange(1, _GRID + 1) / _GRID, group.shared.time.dtype)
    times = group.shared.time * shares
    of_one = jax.vmap(lambda path, time: path.at(time).pos, (None, 0))
    return times, jax.vmap(of_one, (0, None))(group.shared.target, times)


def _next(
    group: InterceptGroup, table: tuple[Array, Array], last: _Meeting, target: Array
) -> _Meeting:
    times, positions = table[0], table[1][target]
    limits = group.shared.limits
    away = positions - last.position[None]
    distance = jnp.sqrt(jnp.maximum(jnp.sum(away**2, axis=1), 1e-12))
    heading = jnp.arctan2(away[:, 1], away[:, 0])
    turn = jnp.abs((heading - last.heading + np.pi) % (2.0 * np.pi) - np.pi)
    # With speed v and curvature kappa, the turn rate v kappa is greatest where the curvature and
    # the lateral acceleration v^2 kappa both reach their limits.
    rate = _TURNING * jnp.sqrt(limits.curvature * limits.lateral_acceleration)
    lack = last.time + (distance / (_PACE * limits.speed) + turn / rate) - times
    first = jnp.where(jnp.any(lack <= 0.0), jnp.argmax(lack <= 0.0), jnp.argmin(lack))
    return _Meeting(
        time=jnp.maximum(times[first], last.time),
        position=positions[first],
        heading=heading[first],
        delay=last.delay + jnp.maximum(lack[first], 0.0),
    )


def _rank(group: InterceptGroup, table: tuple[Array, Array], order: Array) -> Array:
    def advance(last: _Meeting, target: Array) -> tuple[_Meeting, None]:
        return _select(group.present[target], _next(group, table, last, target), last), None

    last, _ = jax.lax.scan(advance, _start(group), order)
    return last.time + 10.0 * last.delay


def _select(condition: Array, meeting: _Meeting, other: _Meeting) -> _Meeting:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), meeting, other)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Best(Decision):
    """Decision that proposes the orders of targets that are estimated to end earliest.

    All N! orders of the N <= 8 targets are estimated. The planner plans each of the best orders,
    the finalists, and selects the plan whose last meeting is earliest.

    Attributes:
        finalists: number of orders that are planned.
    """

    finalists: int = 6

    def __post_init__(self) -> None:
        require_settings(self)

    def propose(self, case: InterceptGroup) -> GroupChoice:
        """Return the F = `finalists` best orders of a group's N targets, best first, (F, N)."""
        num = case.num_targets
        rule = (
            f"at most {MOST_PERMUTED}, because all orders are evaluated (for more targets take the "
        )
        rule += "planner direct with the decision search)"
        require(num <= MOST_PERMUTED, "targets", rule, num)
        orders = jnp.asarray(list(itertools.permutations(range(num))), jnp.int32)
        rank = jax.vmap(functools.partial(_rank, case, _timetable(case)))(orders)
        # Orders that differ only in the positions of absent targets are equivalent. Only the order
        # that ends with the absent targets, in ascending order, is proposed.
        exists = case.present[orders]
        is_last = jnp.all(exists[:, 1:] <= exists[:, :-1], axis=1)
        falls = (orders[:, 1:] < orders[:, :-1]) & ~exists[:, :-1]
        is_proposed = is_last & ~jnp.any(falls, axis=1)
        ranking = jnp.argsort(jnp.where(is_proposed, rank, jnp.inf))
        chosen = ranking[: min(self.finalists, len(orders))]
        # If there are fewer than `finalists` orders, the best one is repeated. This takes no time,
        # because `GroupIntercept` plans equal drives only once.
        chosen = jnp.where(is_proposed[chosen], chosen, chosen[0])
        return GroupChoice(order=orders[chosen])


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Greedy(Decision):
    """Decision that always meets next the target with the earliest estimated meeting."""

    def propose(self, case: InterceptGroup) -> GroupChoice:
        """Return the greedy order of a group's N targets as the only proposal, (1, N)."""
        table, num = _timetable(case), case.num_targets
        last, is_open, order = _start(case), jnp.ones(num, bool), []
        for _ in range(num):
            meetings = jax.vmap(functools.partial(_next, case, table, last))(jnp.arange(num))
            # A rank of 1e9 puts absent targets behind all targets that exist.
            rank = jnp.where(case.present, meetings.time + 10.0 * meetings.delay, 1e9)
            target = jnp.argmin(jnp.where(is_open, rank, jnp.inf))
            chosen = jax.tree.map(lambda leaf, at=target: leaf[at], meetings)
            last = _select(case.present[target], chosen, last)
            is_open = is_open & (jnp.arange(num) != target)
            order.append(target)
        return GroupChoice(order=jnp.stack(order).astype(jnp.int32)[None])


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Given(Decision):
    """Decision that uses the order stored in each case, with absent targets moved to the end."""

    def check(self, cases: InterceptGroup) -> None:
        """Raise `ValueError` unless the order in every case is a permutation of its targets."""
        require_orders(cases.order)

    def propose(self, case: InterceptGroup) -> GroupChoice:
        """Return the order of N targets stored in one case as the only proposal, (1, N)."""
        present_first = jnp.argsort(~case.present[case.order], stable=True)
        return GroupChoice(order=case.order[present_first][None])


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Search(Decision):
    """Decision for many targets: a local search that starts from the greedy order.

    Three local searches follow each other. The first ignores the time that turns take, the second
    counts a share of it, and the third all of it.

    Attributes:
        moves: greatest number of moves of each local search.
    """

    moves: int = 40

    def propose(self, case: InterceptGroup) -> GroupChoice:
        """Return the improved order of a group's N targets as the only proposal, (1, N)."""
        start = _start(case)
        toward = jnp.stack([jnp.cos(start.heading), jnp.sin(start.heading)])
        departure = Departure(start.position, toward, start.time)
        table, order = make_table(case), Greedy().propose(case).order[0]
        for share in (0.0, 0.3, 1.0):
            some = dataclasses.replace(table, delay=share * table.delay)
            order = improve(case, some, departure, order, 0, self.moves)
        return GroupChoice(order=order[None])
