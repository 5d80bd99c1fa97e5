"""A Brax environment in which one step is one decision, and its reward what became of the plan.

It is batched itself: `reset` takes a batch of keys and `step` a batch of actions, so that the
planner in it solves all cases together, by the kernels of a GPU too. The lanes are shared among
the suites evenly, each planned at its own number of targets. As in paper 000, IV-B, an episode is
one step: the next cases are drawn in it, and never the same again.
"""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State
from jax import Array

from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.multistart import solve_batch
from planner_jax.optimise.problem import Round
from planner_jax.policies.observation import FEATURES, PER_TARGET, choice_of, observe
from planner_jax.protocol import is_solved
from planner_jax.task.catch.card import SUITES
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.estimate import earliest_next, shortfall, timetable
from planner_jax.task.catch.exact import ExactCatch
from planner_jax.task.catch.suites import draw_by_key

# What the terms of a reward count; `last` and `ratio` only of solved cases, and `violation` only
# of others, lest a policy be paid for early catches that it does not make.
WEIGHTS = {"solved": 1.0, "last": 5.0, "ratio": -2.0, "violation": -0.5}


class CatchEnv(Env):
    """Decisions about catches, planned by `ExactCatch` from one start or estimated.

    Args:
        suites: whose cases are drawn.
        iterations: of the planner, one number a suite; zero has the estimate judge instead.
        weights: of the terms, by name as in `WEIGHTS`.
    """

    def __init__(
        self,
        suites: tuple[str, ...],
        iterations: tuple[int, ...],
        weights: Mapping[str, float] = WEIGHTS,
    ):
        self.suites, self.iterations = tuple(suites), tuple(iterations)
        self.weights = dict(weights)
        self.size = max(SUITES[suite].num_targets for suite in suites)

    def reset(self, rng: Array) -> State:
        """States of a batch of keys (B, 2); B is a multiple of the number of suites."""
        num = rng.shape[0]
        if num % len(self.suites):
            raise ValueError(
                f"lanes must be a multiple of {len(self.suites)}, one share a suite, got {num}"
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
        share = num // len(self.suites)
        parts = []
        for k, cases in enumerate(state.info["cases"]):
            some = action[k * share : (k + 1) * share].reshape(share, self.size, PER_TARGET)
            parts.append(judged(cases, some[:, : cases.num_targets], self.iterations[k]))
        terms = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
        reward = rewarded(terms, self.weights)
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
        last: how much earlier the last catch is than the estimate of `Greedy`, relative.
        ratio: the optimal time ratio (paper 000, eq. 29); zero by the estimate.
        violation: of the plan, 2 at most; by the estimate log(1 + metres out of reach).
    """
    tables = jax.vmap(timetable)(cases)
    choices = jax.vmap(choice_of)(cases, tables, actions)
    nothing = jnp.zeros_like(cases.horizon)
    greedy = jax.vmap(earliest_next)(cases, tables, nothing).times[:, -1]
    if iterations:
        found = solve_batch(ExactCatch(), _attempt(iterations), cases.decided(choices))
        solved, times = is_solved(found.status), found.times
        off = jnp.abs(times - choices.times) / jnp.maximum(times, 1e-3)
        violation, ratio = found.violation, jnp.mean(off, axis=1)
    else:
        far = jax.vmap(shortfall)(cases, choices)
        solved, times = far <= 0.0, choices.times
        violation, ratio = jnp.log1p(far), jnp.zeros_like(far)
    last = (greedy - times[:, -1]) / greedy
    terms = {"solved": solved, "last": last, "ratio": ratio, "violation": violation}
    # A lane that overflows is a bad one, and no more.
    return {
        name: jnp.clip(jnp.nan_to_num(jnp.asarray(term, jnp.float32), nan=2.0), -2.0, 2.0)
        for name, term in terms.items()
    }


@functools.cache
def _attempt(iterations: int) -> Round:
    return Round(starts=1, solver=LbfgsConfig(max_steps=iterations))


def rewarded(terms: Mapping[str, Array], weights: Mapping[str, float]) -> Array:
    """The reward (B,) of raw terms: what a solved case is worth, or what an unsolved one costs."""
    good = sum(weights[name] * terms[name] for name in ("solved", "last", "ratio"))
    bad = weights["violation"] * terms["violation"]
    return jnp.where(terms["solved"] > 0.5, good, bad)
