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
from jax import Array, lax

from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import Status, is_unsolved, require_settings
from planner_jax.task.catch.beam import beam
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.estimate import (
    GRID,
    earliest_next,
    follow,
    length,
    sampled,
    timetable,
)
from planner_jax.task.catch.plan import CatchPlan

LENGTHS = 3  # in which an order of optional targets is proposed
MOST_PERMUTED = 6  # targets, of which all orders are looked at


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


def optimal_time_ratio(cases: CatchCase, plans: CatchPlan) -> np.ndarray:
    """Mean of |T_o - T_p| / T_o over the targets that are caught, (B,) (paper 000, eq. 29).

    Args:
        cases: a batch.
        plans: of them, with the times T_p that were decided and the optimised ones T_o.
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
        order = np.asarray(cases.order)
        wrong = np.flatnonzero((np.sort(order, axis=-1) != np.arange(order.shape[-1])).any(axis=-1))
        if wrong.size:
            raise ArgumentError(
                "order",
                f"a permutation of 0..{order.shape[-1] - 1}",
                shown=f"{order[wrong[0]].tolist()} in case {wrong[0]}",
            )

    def propose(self, case: CatchCase) -> CatchChoice:
        """The one choice of one case, leaves (1, N)."""
        return CatchChoice(order=case.order[None], times=case.times[None], taken=case.present[None])
