"""A policy to begin with: one that learns to decide as `Best` does, from what it planned.

`Best` plans the six most promising of all orders. Of what it kept the network learns, step by step
along this order, which target came next among those that were left, and by how much the
optimised times differ from the estimated ones.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax import Array

from planner_jax.core.protocol import solved
from planner_jax.planning.plan import plan
from planner_jax.policies.observation import HANDICAP, STRETCH, observe, turned
from planner_jax.task.catch.api import planner
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.chain import targets_at
from planner_jax.task.catch.estimate import arrivals, follow, timetable, top_speed
from planner_jax.task.catch.suites import draw

_SOFT = 0.2  # [s]: how much earlier a target has to be to be chosen more than twice as often


@struct.dataclass
class Lessons:
    """What is to be learned of B cases of up to N targets."""

    seen: Array  # (B, N, F)
    rank: Array  # (B, N, N) [s], at each step of each target; infinite where it is not left
    order: Array  # (B, N), which target was caught at each step
    stretch: Array  # (B, N), of the targets, of actions; zero of those that were not caught
    caught: Array  # (B, N) bool, of the targets


def lessons(suites: Sequence[str], num: int, seed: int, size: int) -> Lessons:
    """Cases of suites as `Best` decided and planned them, in random order.

    Args:
        suites: of them.
        num: cases of each suite.
        seed: of the cases.
        size: N, for how many targets there is room.
    """
    best = planner("exact", decide="best")
    parts = []
    for suite in suites:
        cases: Any = jax.tree.map(np.asarray, draw(num, suite, seed))
        plans = plan(best, cases)
        good = np.flatnonzero(solved(plans))
        cases, plans = jax.tree.map(lambda leaf: leaf[good], (cases, plans))  # noqa: B023
        decided = cases.decided(plans.choice)
        parts.append(jax.device_get(_lessons_of(decided, cases.present, plans.times, size)))
    together = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    mixed = np.random.default_rng(seed).permutation(len(together.order))
    return jax.tree.map(lambda leaf: leaf[mixed], together)


def _lessons_of(cases: CatchCase, present: Array, times: Array, size: int) -> Lessons:
    of_case = functools.partial(_lesson, size=size)
    return jax.jit(jax.vmap(of_case))(cases, present, times)


def _lesson(case: CatchCase, present: Array, times: Array, size: int) -> Lessons:
    """What is to be learned of a case as it was decided, of present targets (N,) bool."""
    table, num, order = timetable(case), case.num_targets, case.order
    number = jnp.sum(case.present)
    targets = jax.tree.map(lambda leaf: leaf[order], case.targets)
    caught = targets_at(targets, times).pos
    begins = jnp.concatenate([jnp.zeros_like(times[:1]), times[:-1]])
    places = jnp.concatenate([case.head_state[:1], caught[:-1]])

    def ranked(step: Array, begin: Array, place: Array) -> Array:
        at, _, short = arrivals(table, begin, place, top_speed(case))
        left = present & (step < number) & (jnp.argsort(order) >= step)
        return jnp.where(left, jnp.minimum(at + 10.0 * short, 1e3), jnp.inf)

    rank = jax.vmap(ranked)(jnp.arange(num), begins, places)
    estimated, _ = follow(case, table, order)
    stretch = jnp.clip(jnp.log(times / estimated.times) / STRETCH, -0.95, 0.95)
    stretch = jnp.where(case.present, stretch[jnp.argsort(order)], 0.0)
    absent = size - num
    whole = dataclasses.replace(case, present=present)
    return Lessons(
        seen=jnp.pad(observe(whole, table), ((0, absent), (0, 0))),
        rank=jnp.pad(rank, ((0, absent), (0, absent)), constant_values=jnp.inf),
        order=jnp.pad(order, (0, absent)),
        stretch=jnp.pad(stretch, (0, absent)),
        caught=jnp.pad(case.present, (0, absent)),
    )


def imitated(
    network: Any, some: Lessons, key: Array, steps: int, params: Any, batch: int = 1024
) -> Any:
    """Parameters of a network that has learned from lessons.

    A lesson is learned each time from another side: the world is turned about the vertical axis,
    which changes nothing about a decision.

    Args:
        network: a module of `networks`.
        some: NumPy leaves.
        key: of `jax.random`.
        steps: of Adam, whose rate falls from 1e-3 to zero.
        params: to begin with.
        batch: lessons of a step.
    """
    optimiser = optax.adam(optax.cosine_decay_schedule(1e-3, steps))
    on_device = jax.device_put(some)
    num = len(some.order)

    @jax.jit
    def many(params: Any, on_device: Lessons) -> Any:
        def one(carry: tuple, key: Array) -> tuple:
            params, state = carry
            which, side = jax.random.split(key)
            lanes = jax.random.randint(which, (batch,), 0, num)
            few = jax.tree.map(lambda leaf: leaf[lanes], on_device)
            angles = jax.random.uniform(side, (batch,), maxval=2.0 * np.pi)
            few = dataclasses.replace(few, seen=jax.vmap(turned)(few.seen, angles))
            loss, slope = jax.value_and_grad(_loss)(params, network, few)
            change, state = optimiser.update(slope, state, params)
            return (optax.apply_updates(params, change), state), loss

        keys = jax.random.split(key, steps)
        (params, _), losses = jax.lax.scan(one, (params, optimiser.init(params)), keys)
        return params, losses

    return jax.device_get(many(params, on_device))


def _loss(params: Any, network: Any, some: Lessons) -> Array:
    numbers = jnp.tanh(network.apply(params, some.seen)[..., :2])
    rank = some.rank + HANDICAP * numbers[:, None, :, 0]
    left = jnp.isfinite(some.rank)
    scores = jnp.where(left, -rank / _SOFT, -1e9)
    chosen = jnp.take_along_axis(scores, some.order[..., None], axis=2)[..., 0]
    surprise = jax.nn.logsumexp(scores, axis=2) - chosen
    is_step = jnp.any(left, axis=2)
    off = optax.huber_loss(numbers[..., 1], some.stretch, delta=0.1)
    number = jnp.maximum(jnp.sum(some.caught), 1)
    of_order = jnp.sum(jnp.where(is_step, surprise, 0.0))
    return (of_order + 20.0 * jnp.sum(off * some.caught)) / number
