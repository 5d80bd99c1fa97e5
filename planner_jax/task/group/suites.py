"""Seeded random cases of groups: several targets for one car among walls and moving obstacles.

`docs/suites.md` states how cases are drawn. World frame in the plane, SI units.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from planner_jax.core.checks import floating
from planner_jax.core.registry import suite_named
from planner_jax.task.arguments import make_generators
from planner_jax.task.group.case import InterceptGroup
from planner_jax.task.group.spec import SUITES, TASK
from planner_jax.task.intercept import suites

_TARGET = ("pos", "angle", "speed", "rate")


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    dtype: DTypeLike = jnp.float32,
) -> InterceptGroup:
    """Draw a batch of cases with groups of targets in float64, and cast them to `dtype`.

    The suite is "group" by default, or a suite of another package. Case k of a suite and `seed` is
    always the same; the batch has `num` cases from k = `first` >= 0 on. `ValueError` is raised for
    an unknown suite or a number out of its range.
    """
    suite = suite_named(suite, "group")
    if suite not in SUITES:
        return TASK.other_suite(suite)(num, seed, first)
    spec, randoms, dtype = SUITES[suite], make_generators(suite, num, seed, first), floating(dtype)
    draws, _, _ = suites.draw_accepted(spec, randoms)
    fewest, most = spec.num_targets
    count = np.array([random.integers(fewest, most + 1) for random in randoms])
    targets = [{name: draws[name] for name in _TARGET}]
    targets += [_draw_target(suite, randoms, draws) for _ in range(most - 1)]
    stacked = {name: np.stack([each[name] for each in targets], axis=1) for name in _TARGET}
    shared = suites.cases_of(draws, dtype)
    return InterceptGroup(
        shared=dataclasses.replace(shared, target=suites.path_of(stacked, dtype)),
        present=jnp.asarray(np.arange(most) < count[:, None]),
        order=jnp.asarray(np.broadcast_to(np.arange(most), (num, most)), jnp.int32),
    )


def _draw_target(
    suite: str, randoms: list[np.random.Generator], draws: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    spec, pending = SUITES[suite], np.arange(len(randoms))
    turning = np.array([random.random() < 0.5 for random in randoms])
    targets = {name: np.zeros_like(draws[name]) for name in _TARGET}
    while len(pending):
        uniform = np.stack([randoms[k].random(6) for k in pending])
        meeting = suites.anywhere(uniform[:, :2])
        target = suites.target_to(meeting, spec.time, turning[pending], uniform[:, 2:])
        around = {name: leaf[pending] for name, leaf in draws.items()}
        candidates = {**around, **target, "meeting": meeting}
        is_good = suites.first_cause(spec, candidates) == len(suites.CAUSES)
        for name in _TARGET:
            targets[name][pending[is_good]] = target[name][is_good]
        pending = pending[~is_good]
    return targets
