"""Observations and actions of a policy that decides the order and times of catches.

The observation has one row of features for each target, as in [Yu2023catch, eq. 6], extended by
the target's predicted path. A network can therefore process any number of targets. The action has
two components for each target:

* a handicap [s], added to the earliest time at which the target can be caught. It changes the order
  of the targets.
* a stretch, the logarithm of a factor on the estimated time of the catch.

If all components are zero, the decision equals `Greedy`, which always catches next the target that
can be caught earliest. Every action gives a valid decision: an order and increasing times.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.context import targets_at
from planner_jax.task.catch.decide import beam
from planner_jax.task.catch.estimate import INSTANT, Timetable, arrivals, earliest_next, top_speed

HANDICAP = 4.0  # [s] added to a target's earliest catch time if its first action component is 1
STRETCH = 0.5  # logarithm of the factor on a catch time if the second action component is 1
_SHARES = 8  # number of future times at which a target's predicted position is a feature
FEATURES = 3 + 3 + 3 + 1 + 3 * _SHARES + 3 + 1  # number of features of each target
PER_TARGET = 2  # number of action components per target


def observe(case: CatchCase, table: Timetable) -> Array:
    """Return the features (N, FEATURES) of the N targets of one case; zero for absent targets.

    They are the target's position, velocity, deadline, predicted path and earliest catch, the
    robot's velocity, the number of other targets, and 1. Lengths are divided by 4 m, speeds by
    4 m/s and times by 5 s. `table` has possible times and positions of catches.
    """
    num = case.num_targets
    place, velocity = case.head_state[0], case.head_state[1]
    now = targets_at(case.targets, jnp.zeros_like(case.horizon))
    every = table.times.shape[1] // _SHARES
    path = (table.places[..., every - 1 :: every].mT - place).reshape(num, -1) / 4.0
    time, _, shortfall = arrivals(table, jnp.zeros_like(case.gravity), place, top_speed(case))
    others = jnp.sum(case.present) - 1.0
    columns = [
        (now.pos - place) / 4.0,
        now.vel / 4.0,
        jnp.broadcast_to(velocity / 4.0, (num, 3)),
        case.horizon[:, None] / 5.0 - 1.0,
        path,
        time[:, None] / 5.0,
        jnp.minimum(shortfall, 4.0)[:, None] / 4.0,
        jnp.broadcast_to(others / 5.0, (num, 1)),
    ]
    seen = jnp.concatenate([*columns, jnp.ones((num, 1))], axis=1)
    return jnp.where(case.present[:, None], seen, 0.0).astype(case.gravity.dtype)


def choice_of(case: CatchCase, table: Timetable, action: Array, width: int = 1) -> CatchChoice:
    """Return the order and times of catches for one case, from an action of a policy.

    Args:
        case: one case with N targets.
        table: possible times and positions of catches, from `timetable`.
        action: (N, 2), from -1 to 1 for each target: a handicap, in units of 4 s, which is added to
            its earliest catch time to order the targets; and a stretch, twice the logarithm of a
            factor on its estimated catch time.
        width: number of partial orders that a beam search with these handicaps continues, if
            targets are optional; for 1, and if no target is optional, there is no search.
    """
    action = jnp.where(case.present[:, None], action, 0.0)
    handicap = HANDICAP * action[:, 0]
    if case.optional and width > 1:
        choice = jax.tree.map(lambda leaf: leaf[0], beam(case, table, width, handicap=handicap))
    else:
        choice = earliest_next(case, table, handicap)
    times = choice.times * jnp.exp(STRETCH * action[choice.order, 1])
    taken = choice.taken[choice.order]
    times = jnp.where(taken, jnp.minimum(times, case.horizon[choice.order]), times)
    # Make the times increase by at least INSTANT [s], the least time from one catch to the next.
    steps = jnp.asarray(INSTANT * np.arange(times.size), times.dtype)
    rising = lax.cummax(times - steps) + steps
    return dataclasses.replace(choice, times=rising)
