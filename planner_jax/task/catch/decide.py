"""When and in what order to catch: by estimated arrival, or the best of all orders.

Where targets are optional a decision also settles which are left, and every order is proposed
in several lengths: the planner keeps the plan that catches most.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import Status, is_unsolved, require_settings
from planner_jax.task.arguments import require_orders
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.estimate import (
    GRID,
    INSTANT,
    Timetable,
    arrivals,
    earliest_next,
    follow,
    later_by_shortfall,
    length,
    sampled,
    takeable,
    timetable,
    top_speed,
)
from planner_jax.task.catch.plan import CatchPlan

LENGTHS = 3  # in which an order of optional targets is proposed
MOST_PERMUTED = 6  # targets, of which all orders are estimated
MOST_SEARCHED = 100  # targets, of which a beam search finds orders
_WORD = 24  # bits of a number that says which targets are taken


def closest_approach(cases: CatchCase) -> Array:
    """Return the distance (N,) or (B, N) [m] of targets from the net's reach; zero is within reach.

    A bound that no plan can beat, at 64 times up to the horizon: the quadrotor leaves with its
    velocity and flies at its greatest speed in any direction, above the least height.
    """
    return _closest_approach(cases) if cases.batch_shape == () else _closest_approaches(cases)


def _closest_approach(case: CatchCase) -> Array:
    """`closest_approach` of one case."""
    net, limits = case.net, case.limits
    times, states, speed = sampled(case)
    distance = length(states.pos - case.head_state[0][:, None])
    # The target moves on between two of the times.
    slack = net.height + net.radius + (speed + limits.speed) * case.horizon[:, None] / GRID
    far = distance - limits.speed * times - slack
    low = limits.min_height - states.pos[:, 2] - slack
    gap = jnp.min(jnp.maximum(jnp.maximum(far, low), 0.0), axis=1)
    return jnp.where(case.present, gap, 0.0)


_closest_approaches = jax.jit(jax.vmap(_closest_approach))


def in_several_lengths(case: CatchCase, choices: CatchChoice) -> CatchChoice:
    """Choices (K, N) as they are, or (K * LENGTHS, N) where targets are optional.

    Each is then also proposed without its last catch, its last two, ...: whether the last ones
    can be reached is more than an estimate knows.
    """
    if not case.optional:
        return choices

    def of_choice(choice: CatchChoice) -> CatchChoice:
        place = jnp.argsort(choice.order)
        number = jnp.sum(choice.taken) - np.arange(LENGTHS)
        taken = choice.taken & (place < number[:, None])
        whole = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (LENGTHS, *leaf.shape)), choice)
        return dataclasses.replace(whole, taken=taken)

    several = jax.vmap(of_choice)(choices)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), several)


@struct.dataclass
class _Partial:
    """W beginnings of orders in a beam search."""

    rank: Array  # (W,) [s], infinite where there is none
    short: Array  # (W,) [m], out of the estimate's reach so far
    time: Array  # (W,) [s], of the last catch
    place: Array  # (W, 3) [m], of the last catch
    position: Array  # (W, N) of each target in the order; N where it is left so far
    times: Array  # (W, N) [s], of each target


def beam(case: CatchCase, table: Timetable, width: int) -> CatchChoice:
    """Return orders of one case that take most targets, the earliest of them, leaves (W, N).

    After each catch the W best beginnings go on, at most one for the same targets with the same
    last one: a bounded search, which may miss the best order. Where fewer than W are found, the
    first one is repeated.

    Raises:
        ValueError: there are more than `MOST_SEARCHED` targets.
    """
    num, speed = case.num_targets, top_speed(case)
    if num > MOST_SEARCHED:
        raise ArgumentError("targets", f"at most {MOST_SEARCHED} of a case", num)
    from_all = jax.vmap(arrivals, (None, 0, 0, None))
    # Which targets are taken, in words of so many bits that 32 hold one and the last target, too.
    words = np.arange(0, num, _WORD)
    place = np.arange(num) - words[:, None]
    inside = (place >= 0) & (place < _WORD)
    bits = jnp.asarray(np.where(inside, 1 << np.clip(place, 0, _WORD - 1), 0), jnp.int32)

    def advance(now: _Partial, step: Array) -> tuple[_Partial, _Partial]:
        times, places, shortfalls = from_all(table, now.time, now.place, speed)
        times = jnp.maximum(times, now.time[:, None] + INSTANT)
        left = now.position == num
        possible = left & jax.vmap(takeable, (None, 0))(case, shortfalls)
        short = now.short[:, None] + shortfalls
        rank = later_by_shortfall(times, short)
        rank = jnp.where(possible & jnp.isfinite(now.rank)[:, None], rank, jnp.inf).ravel()
        taken = jnp.sum(jnp.where(left, 0, bits[:, None]), axis=2, keepdims=True)
        *others, last = (taken | bits[:, None]).reshape(len(words), -1)
        state = (*others, last * num + jnp.tile(np.arange(num), width))
        # Of equal states only the first one, in order of their ranks, goes on.
        sorted_ = jnp.lexsort((rank, *state))
        alike = [jnp.diff(word[sorted_], prepend=-1) == 0 for word in state]
        again = functools.reduce(jnp.logical_and, alike)
        rank = jnp.where(jnp.zeros_like(again).at[sorted_].set(again), jnp.inf, rank)
        chosen = jnp.argsort(rank)[:width]
        row, target = chosen // num, chosen % num
        lanes = jnp.arange(width)
        then = _Partial(
            rank=rank[chosen],
            short=short[row, target],
            time=times[row, target],
            place=places[row, target],
            position=now.position[row].at[lanes, target].set(step.astype(jnp.int32)),
            times=now.times[row].at[lanes, target].set(times[row, target]),
        )
        return then, then

    begin = _Partial(
        rank=jnp.where(np.arange(width) == 0, 0.0, jnp.inf).astype(case.gravity.dtype),
        short=jnp.zeros(width, case.gravity.dtype),
        time=jnp.zeros(width, case.gravity.dtype),
        place=jnp.broadcast_to(case.head_state[0], (width, 3)),
        position=jnp.full((width, num), num, jnp.int32),
        times=jnp.zeros((width, num), case.gravity.dtype),
    )
    _, depths = lax.scan(advance, begin, jnp.arange(num))
    depths = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), begin, depths)
    most = jnp.sum(jnp.any(jnp.isfinite(depths.rank[1:]), axis=1))
    found = jax.tree.map(lambda leaf: leaf[most], depths)
    chosen = jnp.where(jnp.isfinite(found.rank), np.arange(width), 0)
    return jax.vmap(_choice)(found.position[chosen], found.times[chosen])


def _choice(position: Array, times: Array) -> CatchChoice:
    """Return the choice of one order, from the position and the time of each target (N,)."""
    num = position.size
    order = jnp.argsort(position, stable=True)
    taken = position < num
    rising = jnp.where(taken, times, 0.0)[order]
    behind = jnp.maximum(jnp.arange(num) - jnp.sum(taken) + 1, 0)
    rising = lax.cummax(rising) + INSTANT * behind
    return CatchChoice(order=order.astype(jnp.int32), times=rising, taken=taken)


def optimal_time_ratio(cases: CatchCase, plans: CatchPlan) -> np.ndarray:
    """Return the mean of |T_o - T_p| / T_o over the caught targets, (B,) [Yu2023catch, eq. 29].

    The times T_p were decided, and the times T_o are optimised.
    """
    decided_times, optimised = np.asarray(plans.decided_times), np.asarray(plans.times)
    present = np.asarray(cases.present & plans.choice.taken)
    present = np.take_along_axis(present, np.asarray(plans.order), axis=1)
    with np.errstate(all="ignore"):
        ratio = np.where(present, np.abs(optimised - decided_times) / optimised, 0.0)
        return ratio.sum(axis=1) / present.sum(axis=1)


class CatchDecision:
    """What the decisions about catches have in common."""

    def check(self, cases: CatchCase) -> None:
        """Any batch will do."""

    def rank(self, plans: CatchPlan) -> Array:
        """The time of the last catch [s], one a plan; far later for any target that is left."""
        return plans.times[..., -1] + 100.0 * (plans.times.shape[-1] - plans.num_taken)

    def explain(self, case: CatchCase, status: Array) -> Array:
        """OUT_OF_REACH for an unsolved case with a target that `closest_approach` rules out."""
        away = jnp.max(_closest_approach(case)) > 0.0
        unsolved = is_unsolved(status) | (status == Status.OUT_OF_TIME)
        return jnp.where(unsolved & away, jnp.int32(Status.OUT_OF_REACH), status)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Best(CatchDecision):
    """The most promising of all orders are planned, and the earliest last catch is kept.

    All N! orders are estimated. Those with the least shortfall, then the earliest last catch,
    are the finalists. Beyond six targets, and where they are optional, the orders are those that
    a beam search of bounded width finds, which may miss the best one, of at most 100 targets.
    """

    finalists: int = 6  # orders that are planned
    width: int = 64  # of the beam

    def __post_init__(self) -> None:
        require_settings(self)
        if self.width < self.finalists:
            raise ArgumentError("width", f">= {self.finalists} finalists", self.width)

    def propose(self, case: CatchCase) -> CatchChoice:
        """The finalists of one case, leaves (F, N)."""
        table = timetable(case)
        if case.optional or case.num_targets > MOST_PERMUTED:
            found = beam(case, table, self.width)
            return in_several_lengths(case, jax.tree.map(lambda x: x[: self.finalists], found))
        orders = jnp.asarray(list(itertools.permutations(range(case.num_targets))), jnp.int32)
        choices, shortfall = jax.vmap(functools.partial(follow, case, table))(orders)
        rank = choices.times[:, -1] + 10.0 * shortfall
        chosen = jnp.argsort(rank)[: min(self.finalists, len(orders))]
        return jax.tree.map(lambda leaf: leaf[chosen], choices)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Greedy(CatchDecision):
    """Next is caught whatever can be caught earliest."""

    def propose(self, case: CatchCase) -> CatchChoice:
        """The one choice for one case, leaves (1, N), or (LENGTHS, N) if targets are optional."""
        choice = earliest_next(case, timetable(case), jnp.zeros_like(case.horizon))
        return in_several_lengths(case, jax.tree.map(lambda leaf: leaf[None], choice))


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Random(CatchDecision):
    """Next is any target that can be caught, as early as it can be; the same for equal cases."""

    seed: int = 0

    def propose(self, case: CatchCase) -> CatchChoice:
        """The one choice for one case, leaves (1, N), or (LENGTHS, N) if targets are optional."""
        table = timetable(case)
        own = lax.bitcast_convert_type(jnp.sum(table.places).astype(jnp.float32), jnp.uint32)
        key = jax.random.fold_in(jax.random.key(self.seed), own)
        handicap = 1e3 * jax.random.uniform(key, case.horizon.shape, case.horizon.dtype)
        choice = earliest_next(case, table, handicap)
        return in_several_lengths(case, jax.tree.map(lambda leaf: leaf[None], choice))


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Given(CatchDecision):
    """Order and times are those that the cases hold."""

    def check(self, cases: CatchCase) -> None:
        """Raise `ValueError` unless every order is a permutation."""
        require_orders(cases.order)

    def propose(self, case: CatchCase) -> CatchChoice:
        """The one choice of one case, leaves (1, N)."""
        return CatchChoice(order=case.order[None], times=case.times[None], taken=case.present[None])
