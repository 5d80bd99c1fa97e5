"""A Brax environment in which one step is one decision, and its reward what became of the plan.

It is batched itself: `reset` takes a batch of keys and `step` a batch of actions, so that the
planner in it solves all cases together, by the kernels of a GPU too. The lanes are shared among
the suites evenly, each planned at its own number of targets. As in [Yu2023catch, IV-B], an episode
is one step: the next cases are drawn in it, and never the same again.
"""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from jax import Array

from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import is_solved
from planner_jax.optimise.multistart import solve_batch
from planner_jax.optimise.settings import LbfgsConfig, Round
from planner_jax.policies.observation import FEATURES, PER_TARGET, choice_of, observe
from planner_jax.policies.settings import WEIGHTS
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.decide import in_several_lengths
from planner_jax.task.catch.default_planner import ExactCatch
from planner_jax.task.catch.estimate import earliest_next, shortfall, timetable
from planner_jax.task.catch.spec import SUITES
from planner_jax.task.catch.suites import draw_by_key

# Terms of a reward that count only of cases that are solved, lest a policy be paid for early
# catches that it does not make; `violation` counts only of others.
_GATED = ("solved", "last", "ratio", "caught")


class CatchEnv(Env):
    """Decisions about catches, planned by `ExactCatch` from one start or estimated.

    Args:
        suites: whose cases are drawn.
        iterations: of the planner, one number a suite; zero has the estimate judge instead.
            Suites whose cases are alike in shape, and which are planned alike, are planned in one.
        weights: of the terms of `judged`, by name, each one number or one a suite.
    """

    def __init__(
        self,
        suites: tuple[str, ...],
        iterations: tuple[int, ...],
        weights: Mapping[str, float | tuple[float, ...]] = WEIGHTS,
    ):
        self.suites, self.iterations = tuple(suites), tuple(iterations)
        self.weights = {
            name: np.broadcast_to(np.asarray(value, np.float32), len(self.suites))
            for name, value in weights.items()
        }
        self.size = max(SUITES[suite].num_targets for suite in suites)

    def reset(self, rng: Array) -> State:
        """States of a batch of keys (B, 2); B is a multiple of the number of suites."""
        num = rng.shape[0]
        if num % len(self.suites):
            raise ArgumentError(
                "lanes", f"a multiple of {len(self.suites)}, one share a suite", num
            )
        key, own = jax.random.split(rng[0])
        cases = self._drawn(own, num)
        zero = jnp.zeros(num)
        steps = {"sum_reward": zero, "length": zero}
        info = {
            "key": key,
            "cases": cases,
            "truncation": zero,
            "episode_done": zero,
            "episode_metrics": {**steps, **{name: zero for name in WEIGHTS}},
        }
        return State(None, self._seen(cases), zero, zero, {}, info)

    def step(self, state: Any, action: Array) -> State:
        """What became of the actions (B, size * PER_TARGET), and the next cases."""
        key, own = jax.random.split(state.info["key"])
        num = action.shape[0]
        actions = action.reshape(len(self.suites), -1, self.size, PER_TARGET)
        terms = self._judged(state.info["cases"], actions)
        share = num // len(self.suites)
        reward = rewarded(terms, {k: np.repeat(one, share) for k, one in self.weights.items()})
        cases, one = self._drawn(own, num), jnp.ones(num)
        steps = {"sum_reward": reward, "length": one}
        info = {
            **state.info,
            "key": key,
            "cases": cases,
            "episode_done": one,
            "episode_metrics": {**steps, **terms},
        }
        return state.replace(obs=self._seen(cases), reward=reward, done=one, info=info)

    def _judged(self, cases: tuple[CatchCase, ...], actions: Array) -> dict[str, Array]:
        """The raw terms (B,) of actions (S, B / S, size, PER_TARGET) on the cases of S suites."""
        alike: dict[Any, list[int]] = {}
        for k, some in enumerate(cases):
            key = (*map(jnp.shape, jax.tree.leaves(some)), jax.tree.structure(some))
            alike.setdefault((self.iterations[k], *key), []).append(k)
        parts: dict[int, dict[str, Array]] = {}
        for (iterations, *_), places in alike.items():
            together = jax.tree.map(lambda *x: jnp.concatenate(x), *(cases[k] for k in places))
            acts = jnp.concatenate([actions[k, :, : together.num_targets] for k in places])
            terms = judged(together, acts, iterations)
            for place, k in enumerate(places):
                share = actions.shape[1]
                own = slice(place * share, (place + 1) * share)
                parts[k] = {name: term[own] for name, term in terms.items()}
        in_order = [parts[k] for k in range(len(cases))]
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *in_order)

    def _drawn(self, key: Array, num: int) -> tuple[CatchCase, ...]:
        share = num // len(self.suites)
        keys = jax.random.split(key, len(self.suites))
        return tuple(draw_by_key(k, share, s) for k, s in zip(keys, self.suites, strict=True))

    def _seen(self, cases: tuple[CatchCase, ...]) -> Array:
        """Observations (B, size * FEATURES), zero for absent targets."""

        def of_suite(cases: CatchCase) -> Array:
            seen = jax.vmap(lambda case: observe(case, timetable(case)))(cases)
            absent = self.size - cases.num_targets
            return jnp.pad(seen, ((0, 0), (0, absent), (0, 0)))

        seen = jnp.concatenate([of_suite(some) for some in cases])
        return seen.reshape(len(seen), -1)

    @property
    def observation_size(self) -> int:
        """Of one lane."""
        return self.size * FEATURES

    @property
    def action_size(self) -> int:
        """Of one lane."""
        return self.size * PER_TARGET

    @property
    def backend(self) -> str:
        """No physics: what is planned is not flown."""
        return "planner_jax"


def judged(cases: CatchCase, actions: Array, iterations: int) -> dict[str, Array]:
    """The raw terms (B,) of actions (B, N, PER_TARGET) on a batch, without a gate.

    Args:
        cases: (B,).
        actions: from -1 to 1.
        iterations: of the planner; zero has the estimate judge instead.

    Returns:
        solved: 1 or 0.
        last: how much earlier the last catch is than the estimate of `Greedy`, relative; zero
            where targets are optional.
        caught: how many more targets are taken than by `Greedy`, relative; zero but there.
        ratio: the optimal time ratio [Yu2023catch, eq. 29]; zero by the estimate.
        violation: of the plan, 2 at most; by the estimate log(1 + metres out of reach).
    """
    tables = jax.vmap(timetable)(cases)
    choices = jax.vmap(choice_of)(cases, tables, actions)
    nothing = jnp.zeros_like(cases.horizon)
    greedy = jax.vmap(earliest_next)(cases, tables, nothing)
    if iterations:
        choices, found = _planned(cases, choices, iterations)
        solved, times = is_solved(found.status), found.times
        off = jnp.abs(times - choices.times) / jnp.maximum(times, 1e-3)
        taken = jnp.take_along_axis(choices.taken, choices.order, axis=1)
        number = jnp.maximum(jnp.sum(taken, axis=1), 1)
        violation, ratio = found.violation, jnp.sum(jnp.where(taken, off, 0.0), axis=1) / number
    else:
        far = jax.vmap(shortfall)(cases.with_choice(choices), choices)
        solved, times = far <= 0.0, choices.times
        violation, ratio = jnp.log1p(far), jnp.zeros_like(far)
    last, caught = (greedy.times - times)[:, -1] / greedy.times[:, -1], jnp.zeros(len(times))
    if cases.optional:
        taken, reference = (jnp.sum(choice.taken, axis=1) for choice in (choices, greedy))
        last, caught = caught, (taken - reference) / jnp.maximum(reference, 1)
    terms = {
        "solved": solved,
        "last": last,
        "ratio": ratio,
        "caught": caught,
        "violation": violation,
    }
    # A lane that overflows is a bad one, and no more.
    return {
        name: jnp.clip(jnp.nan_to_num(jnp.asarray(term, jnp.float32), nan=2.0), -2.0, 2.0)
        for name, term in terms.items()
    }


def _planned(cases: CatchCase, choices: CatchChoice, iterations: int) -> tuple[CatchChoice, Any]:
    """Choices (B, N) and their plans; where targets are optional, in the length that is best."""
    if not cases.optional:
        return choices, solve_batch(ExactCatch(), _attempt(iterations), cases.with_choice(choices))
    several = jax.vmap(in_several_lengths)(cases, jax.tree.map(lambda x: x[:, None], choices))
    num = several.times.shape[1]
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), several)
    tried = jax.tree.map(lambda leaf: jnp.repeat(leaf, num, axis=0), cases).with_choice(flat)
    found = solve_batch(ExactCatch(), _attempt(iterations), tried)
    each = jax.tree.map(lambda leaf: leaf.reshape(-1, num, *leaf.shape[1:]), (flat, found))
    # The first that is solved is the longest.
    best = jnp.argmax(is_solved(each[1].status), axis=1)
    return jax.tree.map(lambda leaf: leaf[jnp.arange(len(best)), best], each)


@functools.cache
def _attempt(iterations: int) -> Round:
    return Round(starts=1, solver=LbfgsConfig(max_steps=iterations))


def rewarded(terms: Mapping[str, Array], weights: Mapping[str, Any]) -> Array:
    """The reward (B,) of raw terms: what a solved case is worth, or what an unsolved one costs.

    Args:
        terms: of `judged`.
        weights: of each, () or (B,).
    """
    good = sum(weights[name] * terms[name] for name in _GATED)
    bad = weights["violation"] * terms["violation"]
    return jnp.where(terms["solved"] > 0.5, good, bad)
