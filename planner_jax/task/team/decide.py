"""The joint decision of a team: which robot shall catch which targets.

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
from planner_jax.task.catch.estimate import timetable
from planner_jax.task.team.case import TeamCase

_SWEEPS = 3  # number of sweeps over all pairs of more than two robots
_AT_ONCE = 4  # number of cases whose pairs of sequences are compared at once; bounds the memory
_PER_SECOND = 1e-3  # value of a second of a sequence's rank, in caught targets


@functools.partial(jax.jit, static_argnums=(1, 2))
def assign(cases: TeamCase, width: int, margin: float) -> Array:
    """Return which of M targets each of N robots shall catch, (B, N, M) bool, for B cases.

    The search keeps `width` sequences of each length for each robot. Its estimated flights may miss
    a target by `margin` [m].
    """
    return lax.map(lambda case: _assign(case, width, margin), cases, batch_size=_AT_ONCE)


def _assign(case: TeamCase, width: int, margin: float) -> Array:
    table, num = timetable(case.shared), case.shared.num_targets

    case_of = lambda head: dataclasses.replace(case.shared, head_state=head)  # noqa: E731
    search = lambda head: decide.sequences(case_of(head), table, width, margin)  # noqa: E731
    found = jax.vmap(search)(case.head_states)
    taken = (found.position < num).reshape(case.num_robots, -1, num)
    rank = found.rank.reshape(case.num_robots, -1)
    value = jnp.sum(taken, axis=2).astype(rank.dtype) - _PER_SECOND * rank
    chosen = jnp.zeros(case.num_robots, jnp.int32)  # sequences without a catch
    pairs = list(itertools.combinations(range(case.num_robots), 2))
    for i, j in pairs * (_SWEEPS if len(pairs) > 1 else 1):
        now = taken[jnp.arange(case.num_robots), chosen.at[jnp.array([i, j])].set(0)]
        is_free = ~jnp.any(taken & jnp.any(now, axis=0)[None, None], axis=2)
        own = jnp.where(is_free, value, -jnp.inf)
        common = jnp.matmul(taken[i].astype(rank.dtype), taken[j].astype(rank.dtype).T)
        total = jnp.where(common > 0.0, -jnp.inf, own[i][:, None] + own[j][None])
        first, second = jnp.divmod(jnp.argmax(total), total.shape[1])
        chosen = chosen.at[i].set(first.astype(jnp.int32)).at[j].set(second.astype(jnp.int32))
    return taken[jnp.arange(case.num_robots), chosen]
