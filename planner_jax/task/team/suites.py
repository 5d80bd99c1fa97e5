"""Named, seeded suites of team cases, with the targets of suites of the task `catch`."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from planner_jax.core.registry import suite_named
from planner_jax.task.catch import suites as catches
from planner_jax.task.catch.case import START
from planner_jax.task.team.case import LEAST_DISTANCE, TeamCase
from planner_jax.task.team.spec import SUITES, TASK

_RADIUS = 3.0  # [m], of the circle on which the robots start


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    dtype: DTypeLike = jnp.float32,
) -> TeamCase:
    """Draw a batch of random team cases, whose targets `pj.catch.draw` draws.

    Case k of a suite and `seed` is always the same; the batch has `num` cases from k = `first` >= 0
    on. The suite is "team2-swarm12" by default, or a suite of another package. `ValueError` is
    raised for an unknown suite or a number out of its range.
    """
    suite = suite_named(suite, "team2-swarm12")
    if suite not in SUITES:
        return TASK.other_suite(suite)(num, seed, first)
    name, robots = SUITES[suite]
    shared = catches.draw(num, name, seed, first=first, dtype=dtype)
    angle = 2.0 * np.pi * np.arange(robots) / robots
    states = np.zeros((num, robots, 4, 3))
    states[:, :, 0] = START + _RADIUS * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    heads = jnp.asarray(states, shared.gravity.dtype)
    shared = dataclasses.replace(shared, head_state=heads[:, 0])
    return TeamCase(shared, heads, jnp.full(num, LEAST_DISTANCE, heads.dtype))
