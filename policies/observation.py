"""What a policy sees of a catch, and what its actions mean: order and times.

A policy sees each target by itself ([Yu2023catch, eq. 6], with where the target will be beside
where it is), so that a network may treat any number of them alike. Its action gives each target a
handicap, by how much later than it can be caught it is taken to be, and a stretch of its estimated
time. Without either the decision is that of `Greedy`; every action is a valid one: an order, and
times that rise.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.context import targets_at
from planner_jax.task.catch.estimate import INSTANT, Timetable, arrivals, earliest_next, top_speed

HANDICAP = 4.0  # [s], greatest
STRETCH = 0.5  # greatest logarithm of a time over the estimated one
_SHARES = 8  # of the horizon, at which a target is seen
FEATURES = 3 + 3 + 3 + 1 + 3 * _SHARES + 3 + 1  # of a target; the last one is 1 if it is there
PER_TARGET = 2  # numbers of an action


def observe(case: CatchCase, table: Timetable) -> Array:
    """Features of the targets of one case, (N, FEATURES), zero for absent ones.

    Lengths are in units of 4 m, speeds of 4 m/s, times of 5 s.
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


def turned(seen: Array, angle: Array) -> Array:
    """What is seen (..., N, FEATURES) after a turn () [rad] of the world about a vertical axis."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    parts = jnp.split(seen, [9, 10, 10 + 3 * _SHARES], axis=-1)
    for k in (0, 2):  # the vectors
        x, y, z = jnp.moveaxis(parts[k].reshape(*seen.shape[:-1], -1, 3), -1, 0)
        level = (cosine * x - sine * y, sine * x + cosine * y)
        parts[k] = jnp.stack([*level, z], axis=-1).reshape(parts[k].shape)
    return jnp.concatenate(parts, axis=-1)


def choice_of(case: CatchCase, table: Timetable, action: Array) -> CatchChoice:
    """Order and times of one case by an action (N, PER_TARGET) of numbers from -1 to 1."""
    action = jnp.where(case.present[:, None], action, 0.0)
    choice = earliest_next(case, table, HANDICAP * action[:, 0])
    times = choice.times * jnp.exp(STRETCH * action[choice.order, 1])
    taken = choice.taken[choice.order]
    times = jnp.where(taken, jnp.minimum(times, case.horizon[choice.order]), times)
    # Rising, by an instant at least.
    steps = jnp.asarray(INSTANT * np.arange(times.size), times.dtype)
    rising = lax.cummax(times - steps) + steps
    return dataclasses.replace(choice, times=rising)
