"""The joint decision of a team: which robot shall catch which targets, in which order.

For every robot a beam search finds sequences of catches by the estimates of the task `catch`. Of
two robots' sequences, the pair without a common target that catches most is selected. For more than
two robots this is repeated over all pairs.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
from jax import Array, lax

from planner_jax.task.catch import decide
from planner_jax.task.catch.case import CatchChoice
from planner_jax.task.catch.estimate import timetable
from planner_jax.task.team.case import TeamCase

SWEEPS = 3  # number of sweeps over all pairs of more than two robots
_AT_ONCE = 4  # number of cases whose pairs of sequences are compared at once; bounds the memory
PER_SECOND = 1e-3  # value of a second of a sequence's rank, in caught targets


@functools.partial(jax.jit, static_argnums=1)
def assign(cases: TeamCase, width: int, hastes: Array) -> CatchChoice:
    """Return the choices of N robots of B cases, for each of H factors on the robots' agility.

    A choice says which of M targets a robot shall catch, in which order and when. No target is
    chosen for two robots. Leaves have the shape (B, H, N, M). The search keeps `width` sequences of
    each length for each robot. `estimate.arrival` explains the factors `hastes` (H,): the greater
    the factor, the more catches are chosen, and the fewer plans fulfil their choice.
    """

    def one(case: TeamCase) -> CatchChoice:
        return lax.map(functools.partial(_assign, case, width), hastes)

    return lax.map(one, cases, batch_size=_AT_ONCE)


def _assign(case: TeamCase, width: int, haste: Array) -> CatchChoice:
    table, num = timetable(case.shared), case.shared.num_targets

    def search(head: Array) -> decide.Sequences:
        own = dataclasses.replace(case.shared, head_state=head)
        return decide.sequences(own, table, width, 0.0, haste)

    found = jax.vmap(search)(case.head_states)
    found = jax.tree.map(lambda leaf: leaf.reshape(len(leaf), -1, *leaf.shape[3:]), found)
    taken = found.position < num  # (N, W, M), for W sequences of each of N robots
    rank = found.rank
    value = jnp.sum(taken, axis=2).astype(rank.dtype) - PER_SECOND * rank
    robots = jnp.arange(case.num_robots)
    chosen = jnp.zeros(case.num_robots, jnp.int32)  # sequences without a catch
    pairs = list(itertools.combinations(range(case.num_robots), 2))
    for i, j in pairs * (SWEEPS if len(pairs) > 1 else 1):
        now = taken[robots, chosen.at[jnp.array([i, j])].set(0)]
        is_free = ~jnp.any(taken & jnp.any(now, axis=0)[None, None], axis=2)
        own = jnp.where(is_free, value, -jnp.inf)
        common = jnp.matmul(taken[i].astype(rank.dtype), taken[j].astype(rank.dtype).T)
        total = jnp.where(common > 0.0, -jnp.inf, own[i][:, None] + own[j][None])
        first, second = jnp.divmod(jnp.argmax(total), total.shape[1])
        chosen = chosen.at[i].set(first.astype(jnp.int32)).at[j].set(second.astype(jnp.int32))
    return jax.vmap(decide.choose)(found.position[robots, chosen], found.times[robots, chosen])
