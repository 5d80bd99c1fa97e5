"""In what order to meet the targets of a group: by estimated meetings, or the best of all orders.

The estimate sees a car that turns towards where it meets a target and then drives straight on,
whatever is in the way. It serves to rank orders; legs are then planned for the most promising.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import require_settings
from planner_jax.task.arguments import require_orders
from planner_jax.task.group.case import GroupChoice, InterceptGroup
from planner_jax.task.group.plan import GroupPlan

_GRID = 128  # times at which every target is looked at
_PACE = 0.8  # of the greatest speed, sustained
_TURNING = 0.6  # of the turn rate that limits allow at that speed where both bind, sustained


@struct.dataclass
class _Meeting:
    """A car at a meeting, as the estimate has it."""

    time: Array  # () [s]
    place: Array  # (2,) [m]
    heading: Array  # () [rad]
    late: Array  # () [s], how much more time than there is it and those before would have taken


def _begin(group: InterceptGroup) -> _Meeting:
    shared = group.shared
    heading = shared.start[2]
    ahead = shared.body.middle * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    zero = jnp.zeros_like(shared.time)
    return _Meeting(time=zero, place=shared.start[:2] + ahead, heading=heading, late=zero)


def _timetable(group: InterceptGroup) -> tuple[Array, Array]:
    """Times (K,) [s] up to that of the case, and where the targets are then, (N, K, 2) [m]."""
    shares = jnp.asarray(np.arange(1, _GRID + 1) / _GRID, group.shared.time.dtype)
    times = group.shared.time * shares
    of_one = jax.vmap(lambda path, time: path.at(time).pos, (None, 0))
    return times, jax.vmap(of_one, (0, None))(group.shared.target, times)


def _next(
    group: InterceptGroup, table: tuple[Array, Array], last: _Meeting, target: Array
) -> _Meeting:
    """The earliest meeting with a target after another meeting."""
    times, places = table[0], table[1][target]
    limits = group.shared.limits
    away = places - last.place
    distance = jnp.sqrt(jnp.maximum(jnp.sum(away**2, axis=1), 1e-12))
    heading = jnp.arctan2(away[:, 1], away[:, 0])
    turn = jnp.abs((heading - last.heading + np.pi) % (2.0 * np.pi) - np.pi)
    # v kappa where both its own limit and that of v^2 kappa bind.
    rate = _TURNING * jnp.sqrt(limits.curvature * limits.lateral_acceleration)
    takes = distance / (_PACE * limits.speed) + turn / rate
    lack = last.time + takes - times
    first = jnp.where(jnp.any(lack <= 0.0), jnp.argmax(lack <= 0.0), jnp.argmin(lack))
    return _Meeting(
        time=jnp.maximum(times[first], last.time),
        place=places[first],
        heading=heading[first],
        late=last.late + jnp.maximum(lack[first], 0.0),
    )


def _where(condition: Array, yes: _Meeting, no: _Meeting) -> _Meeting:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _rank(group: InterceptGroup, table: tuple[Array, Array], order: Array) -> Array:
    """Estimated time () [s] of the last meeting in an order (N,); what is late counts tenfold."""

    def advance(last: _Meeting, target: Array) -> tuple[_Meeting, None]:
        return _where(group.present[target], _next(group, table, last, target), last), None

    last, _ = jax.lax.scan(advance, _begin(group), order)
    return last.time + 10.0 * last.late


class GroupDecision:
    """What the decisions about groups have in common."""

    def check(self, cases: InterceptGroup) -> None:
        """Any batch will do."""

    def rank(self, plans: GroupPlan) -> Array:
        """The time of the last meeting [s], one a plan."""
        return plans.cost

    def explain(self, case: InterceptGroup, status: Array) -> Array:
        """What the planner says."""
        return status


MOST_PERMUTED = 8  # targets of a group


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Best(GroupDecision):
    """The most promising of all orders are planned, and the earliest last meeting is kept.

    All N! orders are estimated, of at most 8 targets, and those of the earliest last meeting are
    the finalists.
    """

    finalists: int = 6  # orders that are planned

    def __post_init__(self) -> None:
        require_settings(self)

    def propose(self, case: InterceptGroup) -> GroupChoice:
        """The finalists of one group, leaves (F, N)."""
        num = case.num_targets
        if num > MOST_PERMUTED:
            rule = f"at most {MOST_PERMUTED}, of which all orders are looked at"
            raise ArgumentError("targets", rule, num)
        orders = jnp.asarray(list(itertools.permutations(range(num))), jnp.int32)
        table = _timetable(case)
        rank = jax.vmap(functools.partial(_rank, case, table))(orders)
        # Of orders that differ in absent targets alone, one is enough.
        there = case.present[orders]
        is_first = jnp.all(there[:, 1:] <= there[:, :-1], axis=1)
        falls = (orders[:, 1:] < orders[:, :-1]) & ~there[:, :-1]
        is_wanted = is_first & ~jnp.any(falls, axis=1)
        chosen = jnp.argsort(jnp.where(is_wanted, rank, jnp.inf))[
            : min(self.finalists, len(orders))
        ]
        # Where there are fewer, the best one again; equal legs are planned once.
        chosen = jnp.where(is_wanted[chosen], chosen, chosen[0])
        return GroupChoice(order=orders[chosen])


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Greedy(GroupDecision):
    """Next is met whatever can be met earliest, as estimated."""

    def propose(self, case: InterceptGroup) -> GroupChoice:
        """The one choice for one group, leaves (1, N)."""
        table, num = _timetable(case), case.num_targets
        last, left, order = _begin(case), jnp.ones(num, bool), []
        for _ in range(num):
            meet = functools.partial(_next, case, table, last)
            found = jax.vmap(meet)(jnp.arange(num))
            # Absent targets come last, in any order.
            rank = jnp.where(case.present, found.time + 10.0 * found.late, 1e9)
            target = jnp.argmin(jnp.where(left, rank, jnp.inf))
            chosen = jax.tree.map(lambda leaf, at=target: leaf[at], found)
            last = _where(case.present[target], chosen, last)
            left = left & (jnp.arange(num) != target)
            order.append(target)
        return GroupChoice(order=jnp.stack(order).astype(jnp.int32)[None])


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Given(GroupDecision):
    """The order is that of the cases, absent targets last."""

    def check(self, cases: InterceptGroup) -> None:
        """Raise `ValueError` unless every order is a permutation."""
        require_orders(cases.order)

    def propose(self, case: InterceptGroup) -> GroupChoice:
        """The one choice of one group, leaves (1, N)."""
        present_first = jnp.argsort(~case.present[case.order], stable=True)
        return GroupChoice(order=case.order[present_first][None])
