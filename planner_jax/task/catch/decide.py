"""Decisions on the order and times of catches, from estimates of when targets can be reached.

A decision proposes orders, and the planner plans each of them. If targets are optional, a decision
also selects which targets to catch: it proposes every order also with fewer catches, and the plan
that catches most targets is selected.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.typing import ArrayLike

from planner_jax.core.checks import require_kind
from planner_jax.core.choices import require
from planner_jax.core.protocol import Status, is_unsolved, require_settings
from planner_jax.task.catch import estimate
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.estimate import Timetable, timetable
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.task.decisions import require_orders

LENGTHS = 3  # number of variants of each order of optional targets, with ever fewer catches
MOST_PERMUTED = 6  # greatest number of targets for which all orders are estimated
MOST_SEARCHED = 100  # greatest number of targets for the beam search
_WORD = 24  # number of targets in each integer of the bit set of caught targets


def closest_approach(cases: CatchCase) -> Array:
    """Return a lower bound on the distance by which the net misses each of N targets, [m].

    The result is (N,), or (B, N) for a batch of B cases; it is zero if the target may be within
    reach. The quadrotor is assumed to fly at its greatest speed in any direction. The bound is
    evaluated at 64 times up to the target's horizon.
    """
    require_kind("cases", cases, CatchCase)
    return _closest_approach(cases) if cases.batch_shape == () else _closest_approaches(cases)


def _closest_approach(case: CatchCase) -> Array:
    net, limits = case.net, case.limits
    times, states, speed = estimate.sample_targets(case)
    distance = estimate.length(states.pos - case.head_state[0][None, :, None])
    # `slack` includes the distance that target and quadrotor can move between sampled times.
    step = case.horizon[:, None] / estimate.GRID
    slack = net.height + net.radius + (speed + limits.speed) * step
    far = distance - limits.speed * times - slack
    low = limits.min_height - states.pos[:, 2] - slack
    return jnp.where(case.present, jnp.min(jnp.maximum(jnp.maximum(far, low), 0.0), axis=1), 0.0)


_closest_approaches = jax.jit(jax.vmap(_closest_approach))


def in_several_lengths(case: CatchCase, choices: CatchChoice) -> CatchChoice:
    """Return K choices unchanged, or `LENGTHS` variants of each choice if targets are optional.

    A choice is an order of targets with times. Its variants catch all its targets, all but the
    last, all but the last two and so on, because the estimate is least certain for the last
    catches. Leaves have the shape (K, N) or (K * LENGTHS, N), for N targets.
    """
    if not case.optional:
        return choices

    def of_choice(choice: CatchChoice) -> CatchChoice:
        place = jnp.argsort(choice.order)
        number = jnp.sum(choice.taken) - np.arange(LENGTHS)
        taken = choice.taken[None] & (place[None] < number[:, None])
        whole = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (LENGTHS, *leaf.shape)), choice)
        return dataclasses.replace(whole, taken=taken)

    several = jax.vmap(of_choice)(choices)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), several)


@struct.dataclass
class Sequences:
    """W sequences of equally many catches of the N targets of one case, as a search finds them."""

    rank: Array  # (W,) [s], the least is best; infinite in rows that hold no sequence
    short: Array  # (W,) [m], sum of the distances by which targets are missed
    time: Array  # (W,) [s], of the last catch
    place: Array  # (W, 3) [m], position of the quadrotor at the last catch
    position: Array  # (W, N) int32, index of each target in the sequence; N if it is not in it
    times: Array  # (W, N) [s], of the catch of each target in the sequence


def beam(case: CatchCase, table: Timetable, width: int, handicap: ArrayLike = 0.0) -> CatchChoice:
    """Search for W orders of one case that catch most targets, and catch them early.

    These are the longest sequences that `sequences` finds. If fewer than W orders are found, the
    first one is repeated. For N targets the leaves of the result have the shape (W, N).
    """
    depths = sequences(case, table, width, estimate.MARGIN, handicap=handicap)
    most = jnp.sum(jnp.any(jnp.isfinite(depths.rank[1:]), axis=1))
    found = jax.tree.map(lambda leaf: leaf[most], depths)
    chosen = jnp.where(jnp.isfinite(found.rank), np.arange(width), 0)
    return jax.vmap(choose)(found.position[chosen], found.times[chosen])


def sequences(
    case: CatchCase,
    table: Timetable,
    width: int,
    margin: float,
    haste: Array | float = 1.0,
    handicap: ArrayLike = 0.0,
) -> Sequences:
    """Search for sequences of 0, 1, ..., N catches of one case, W of each length.

    It is a beam search of width W = `width` among the possible catches in `table`. After each catch
    the W sequences with the least ranks continue. The rank is the estimated time plus 10 s for each
    metre that the quadrotor would lack to reach its targets in time, at most `margin` [m] for an
    optional target. `handicap` (N,) [s] of every caught target is added to the rank. Among
    sequences with the same targets and the same last target only the best continues. `haste` is the
    factor on the agility in `estimate.arrival`. The leaves of the result have the shape
    (N + 1, W, ...).

    Raises:
        ValueError: there are more than `MOST_SEARCHED` targets.
    """
    num, speed = case.num_targets, estimate.top_speed(case, haste)
    handicap = jnp.broadcast_to(jnp.asarray(handicap, case.gravity.dtype), (1, num))
    require(num <= MOST_SEARCHED, "targets", f"at most {MOST_SEARCHED} of a case", num)
    arrival = functools.partial(estimate.arrival, speed=speed, haste=haste)
    from_all = jax.vmap(jax.vmap(arrival, (0, None, None)), (None, 0, 0))
    # The set of caught targets is stored as bits of a few 32-bit integers. The last integer also
    # holds the index of the last target.
    words = np.arange(0, num, _WORD)
    place = np.arange(num) - words[:, None]
    inside = (place >= 0) & (place < _WORD)
    bits = jnp.asarray(np.where(inside, 1 << np.clip(place, 0, _WORD - 1), 0), jnp.int32)

    def advance(now: Sequences, step: Array) -> tuple[Sequences, Sequences]:
        times, places, shortfalls = from_all(table, now.time, now.place)
        times = jnp.maximum(times, now.time[:, None] + estimate.INSTANT)
        left = now.position == num
        possible = left & jax.vmap(estimate.can_be_next, (None, 0, None))(case, shortfalls, margin)
        short = now.short[:, None] + shortfalls
        later = jnp.sum(jnp.where(left, 0.0, handicap), axis=1, keepdims=True) + handicap
        rank = estimate.later_by_shortfall(times, short) + later
        rank = jnp.where(possible & jnp.isfinite(now.rank)[:, None], rank, jnp.inf).ravel()
        taken = jnp.sum(jnp.where(left, 0, bits[:, None]), axis=2, keepdims=True)
        *others, last = (taken | bits[:, None]).reshape(len(words), -1)
        state = (*others, last * num + jnp.tile(np.arange(num), width))
        sorted_ = jnp.lexsort((rank, *state))
        alike = [jnp.diff(word[sorted_], prepend=-1) == 0 for word in state]
        again = functools.reduce(jnp.logical_and, alike)
        rank = jnp.where(jnp.zeros_like(again).at[sorted_].set(again), jnp.inf, rank)
        chosen = jnp.argsort(rank)[:width]
        row, target = chosen // num, chosen % num
        lanes = jnp.arange(width)
        then = Sequences(
            rank=rank[chosen],
            short=short[row, target],
            time=times[row, target],
            place=places[row, target],
            position=now.position[row].at[lanes, target].set(step.astype(jnp.int32)),
            times=now.times[row].at[lanes, target].set(times[row, target]),
        )
        return then, then

    begin = Sequences(
        rank=jnp.where(np.arange(width) == 0, 0.0, jnp.inf).astype(case.gravity.dtype),
        short=jnp.zeros(width, case.gravity.dtype),
        time=jnp.zeros(width, case.gravity.dtype),
        place=jnp.broadcast_to(case.head_state[0], (width, 3)),
        position=jnp.full((width, num), num, jnp.int32),
        times=jnp.zeros((width, num), case.gravity.dtype),
    )
    _, depths = lax.scan(advance, begin, jnp.arange(num))
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), begin, depths)


def choose(position: Array, times: Array) -> CatchChoice:
    """Return the choice that a sequence of N targets makes: its `position` and `times`, (N,)."""
    num = position.size
    order = jnp.argsort(position, stable=True)
    taken = position < num
    rising = jnp.where(taken, times, 0.0)[order]
    behind = jnp.maximum(jnp.arange(num) - jnp.sum(taken) + 1, 0)
    rising = lax.cummax(rising) + estimate.INSTANT * behind.astype(times.dtype)
    return CatchChoice(order=order.astype(jnp.int32), times=rising, taken=taken)


def optimal_time_ratio(cases: CatchCase, plans: CatchPlan) -> np.ndarray:
    """Return the mean of |T_o - T_p| / T_o over the caught targets of each case, (B,).

    T_p is a catch's time estimated before planning, T_o its planned time [Yu2023catch, eq. 29].
    """
    require_kind("cases", cases, CatchCase)
    require_kind("plans", plans, CatchPlan)
    decided_times, optimised = np.asarray(plans.decided_times), np.asarray(plans.times)
    present = np.asarray(cases.present & plans.choice.taken)
    present = np.take_along_axis(present, np.asarray(plans.order), axis=1)
    with np.errstate(all="ignore"):
        ratio = np.where(present, np.abs(optimised - decided_times) / optimised, 0.0)
        return ratio.sum(axis=1) / present.sum(axis=1)


class CatchDecision:
    """Base class of decisions on the order and times of catches."""

    def check(self, cases: CatchCase) -> None:
        """Accept every batch of cases; a subclass may raise an error for unsupported cases."""

    def rank(self, plans: CatchPlan) -> Array:
        """Return the time [s] of each plan's last catch, plus 100 s for each target not caught."""
        left = plans.times.shape[-1] - plans.num_taken
        dtype = plans.times.dtype if isinstance(left, jax.Array) else np.float64
        return plans.times[..., -1] + 100.0 * left.astype(dtype)

    def explain(self, case: CatchCase, status: Array) -> Array:
        """Return OUT_OF_REACH if a case is unsolved and a target is provably out of reach."""
        away = jnp.max(_closest_approach(case)) > 0.0
        unsolved = is_unsolved(status) | (status == Status.OUT_OF_TIME)
        return jnp.where(unsolved & away, jnp.int32(Status.OUT_OF_REACH), status)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Best(CatchDecision):
    """Decision that proposes the orders with the least ranks; all of them are then planned.

    The rank of an order is the estimated time of its last catch plus 10 s for each metre by which
    the quadrotor would miss its targets. All orders of up to six targets are ranked. For more (at
    most 100) or optional targets, a beam search ranks only some orders and may miss the best one.
    The plan with the earliest last catch is selected.

    Attributes:
        finalists: number of orders that are planned.
        width: number of partial orders that the beam search continues.
    """

    finalists: int = 6
    width: int = 64

    def __post_init__(self) -> None:
        require_settings(self)
        require(self.width >= self.finalists, "width", f">= {self.finalists} finalists", self.width)

    def propose(self, case: CatchCase) -> CatchChoice:
        """Return the orders (F, N) of a case with the least ranks, best first for each margin."""
        table = timetable(case)
        if case.optional or case.num_targets > MOST_PERMUTED:
            found = beam(case, table, self.width)
            first = jax.tree.map(lambda leaf: leaf[: self.finalists], found)
            return in_several_lengths(case, first)
        orders = jnp.asarray(list(itertools.permutations(range(case.num_targets))), jnp.int32)
        choices, shortfall = jax.vmap(functools.partial(estimate.follow, case, table))(orders)
        rank = choices.times[:, -1] + 10.0 * shortfall
        chosen = jnp.argsort(rank)[: min(self.finalists, len(orders))]
        return jax.tree.map(lambda leaf: leaf[chosen], choices)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Greedy(CatchDecision):
    """Decision that always catches next the target with the earliest estimated catch."""

    def propose(self, case: CatchCase) -> CatchChoice:
        """Return the greedy order of one case; with optional targets, also shorter orders."""
        table = timetable(case)
        choice = estimate.earliest_next(case, table, self._handicap(case, table))
        return in_several_lengths(case, jax.tree.map(lambda leaf: leaf[None], choice))

    def _handicap(self, case: CatchCase, table: Timetable) -> Array:
        return jnp.zeros_like(case.horizon)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Random(Greedy):
    """Decision that always catches next a random target, the same target for equal cases."""

    seed: int = 0  # seed of the random numbers

    def _handicap(self, case: CatchCase, table: Timetable) -> Array:
        own = lax.bitcast_convert_type(jnp.sum(table.places).astype(jnp.float32), jnp.uint32)
        key = jax.random.fold_in(jax.random.key(self.seed), own)
        return 1e3 * jax.random.uniform(key, case.horizon.shape, case.horizon.dtype)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Given(CatchDecision):
    """Decision that uses the order and the times that are stored in each case."""

    def check(self, cases: CatchCase) -> None:
        """Raise `ValueError` unless the order in every case is a permutation of its targets."""
        require_orders(cases.order)

    def propose(self, case: CatchCase) -> CatchChoice:
        """Return order and times of N targets stored in one case as the only proposal, (1, N)."""
        return CatchChoice(order=case.order[None], times=case.times[None], taken=case.present[None])
