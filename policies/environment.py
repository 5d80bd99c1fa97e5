"""A Brax environment for decisions about catches: one step is one decision.

The reward of a step follows from the plan that the decision leads to. As in
[Yu2023catch, Section IV-B], an episode has one step, and each step draws new cases.

The environment is batched: `reset` takes a batch of keys and `step` a batch of actions, so that
one call of the planner solves all cases. The batch is divided evenly among the suites, and the
cases of each suite keep their own number of targets.
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

# These terms count for solved cases only. Otherwise a policy would be rewarded for early catches
# that no plan achieves. The term `violation` counts for the other cases only.
_GATED = ("solved", "last", "ratio", "caught")


class CatchEnv(Env):
    """An environment that rewards decisions by plans of `ExactCatch`, or by an estimate.

    Suites with the same shapes of cases and the same number of iterations share one call of the
    planner, which starts from one guess a case.

    Args:
        suites: names of the suites from which cases are drawn.
        iterations: number of planner iterations for each suite; zero replaces the planner by the
            estimate of `task.catch.estimate`.
        weights: weights of the terms of `evaluate_actions` by name, each a number or one number
            for each suite.
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
        """Return the first states for keys (B, 2); B is a multiple of the number of suites."""
        num = rng.shape[0]
        if num % len(self.suites):
            raise ArgumentError(
                "lanes", f"a multiple of {len(self.suites)}, one share a suite", num
            )
        key, own = jax.random.split(rng[0])
        cases = self._draw(own, num)
        zero = jnp.zeros(num)
        steps = {"sum_reward": zero, "length": zero}
        info = {
            "key": key,
            "cases": cases,
            "truncation": zero,
            "episode_done": zero,
            "episode_metrics": {**steps, **{name: zero for name in WEIGHTS}},
        }
        return State(None, self._observe(cases), zero, zero, {}, info)

    def step(self, state: Any, action: Array) -> State:
        """Reward the actions (B, size * PER_TARGET) and draw the next cases."""
        key, own = jax.random.split(state.info["key"])
        num = action.shape[0]
        actions = action.reshape(len(self.suites), -1, self.size, PER_TARGET)
        terms = self._evaluate(state.info["cases"], actions)
        share = num // len(self.suites)
        reward = weight_terms(terms, {k: np.repeat(one, share) for k, one in self.weights.items()})
        cases, one = self._draw(own, num), jnp.ones(num)
        steps = {"sum_reward": reward, "length": one}
        info = {
            **state.info,
            "key": key,
            "cases": cases,
            "episode_done": one,
            "episode_metrics": {**steps, **terms},
        }
        return state.replace(obs=self._observe(cases), reward=reward, done=one, info=info)

    def _evaluate(self, cases: tuple[CatchCase, ...], actions: Array) -> dict[str, Array]:
        """Return the unweighted reward terms (B,) of actions (S, B / S, size, PER_TARGET)."""
        alike: dict[Any, list[int]] = {}
        for k, some in enumerate(cases):
            key = (*map(jnp.shape, jax.tree.leaves(some)), jax.tree.structure(some))
            alike.setdefault((self.iterations[k], *key), []).append(k)
        parts: dict[int, dict[str, Array]] = {}
        for (iterations, *_), places in alike.items():
            together = jax.tree.map(lambda *x: jnp.concatenate(x), *(cases[k] for k in places))
            acts = jnp.concatenate([actions[k, :, : together.num_targets] for k in places])
            terms = evaluate_actions(together, acts, iterations)
            for place, k in enumerate(places):
                share = actions.shape[1]
                own = slice(place * share, (place + 1) * share)
                parts[k] = {name: term[own] for name, term in terms.items()}
        in_order = [parts[k] for k in range(len(cases))]
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *in_order)

    def _draw(self, key: Array, num: int) -> tuple[CatchCase, ...]:
        share = num // len(self.suites)
        keys = jax.random.split(key, len(self.suites))
        return tuple(draw_by_key(k, share, s) for k, s in zip(keys, self.suites, strict=True))

    def _observe(self, cases: tuple[CatchCase, ...]) -> Array:
        """Return the observations (B, size * FEATURES), zero for absent targets."""

        def of_suite(cases: CatchCase) -> Array:
            seen = jax.vmap(lambda case: observe(case, timetable(case)))(cases)
            absent = self.size - cases.num_targets
            return jnp.pad(seen, ((0, 0), (0, absent), (0, 0)))

        seen = jnp.concatenate([of_suite(some) for some in cases])
        return seen.reshape(len(seen), -1)

    @property
    def observation_size(self) -> int:
        """Number of features in the observation of one case."""
        return self.size * FEATURES

    @property
    def action_size(self) -> int:
        """Number of components in the action for one case."""
        return self.size * PER_TARGET

    @property
    def backend(self) -> str:
        """Name of the backend; plans are rewarded without a physics simulation."""
        return "planner_jax"


def evaluate_actions(cases: CatchCase, actions: Array, iterations: int) -> dict[str, Array]:
    """Return the unweighted reward terms (B,) of actions (B, N, PER_TARGET).

    Args:
        cases: batch of B cases.
        actions: components from -1 to 1.
        iterations: number of planner iterations; zero replaces the planner by the estimate.

    Returns:
        solved: 1 for a solved case, else 0.
        last: (t_greedy - t) / t_greedy for the time t of the last catch and its estimate under
            the decision `Greedy`; zero in suites with optional targets.
        caught: (n - n_greedy) / n_greedy for the number n of targets taken; zero in suites
            without optional targets.
        ratio: optimal time ratio [Yu2023catch, eq. 29]; zero with the estimate.
        violation: violation of the plan, at most 2; with the estimate log(1 + d) for the distance
            d [m] that the quadrotor falls short of the targets.
    """
    tables = jax.vmap(timetable)(cases)
    choices = jax.vmap(choice_of)(cases, tables, actions)
    nothing = jnp.zeros_like(cases.horizon)
    greedy = jax.vmap(earliest_next)(cases, tables, nothing)
    if iterations:
        choices, found = _plan(cases, choices, iterations)
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
    # A case whose terms overflow gets a poor reward and does not spoil the batch.
    return {
        name: jnp.clip(jnp.nan_to_num(jnp.asarray(term, jnp.float32), nan=2.0), -2.0, 2.0)
        for name, term in terms.items()
    }


def _plan(cases: CatchCase, choices: CatchChoice, iterations: int) -> tuple[CatchChoice, Any]:
    """Plan the choices (B, N); with optional targets keep the longest solved prefix."""
    if not cases.optional:
        return choices, solve_batch(ExactCatch(), _attempt(iterations), cases.with_choice(choices))
    several = jax.vmap(in_several_lengths)(cases, jax.tree.map(lambda x: x[:, None], choices))
    num = several.times.shape[1]
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), several)
    tried = jax.tree.map(lambda leaf: jnp.repeat(leaf, num, axis=0), cases).with_choice(flat)
    found = solve_batch(ExactCatch(), _attempt(iterations), tried)
    each = jax.tree.map(lambda leaf: leaf.reshape(-1, num, *leaf.shape[1:]), (flat, found))
    # Lengths decrease along the axis: the first solved choice is the longest.
    best = jnp.argmax(is_solved(each[1].status), axis=1)
    return jax.tree.map(lambda leaf: leaf[jnp.arange(len(best)), best], each)


@functools.cache
def _attempt(iterations: int) -> Round:
    return Round(starts=1, solver=LbfgsConfig(max_steps=iterations))


def weight_terms(terms: Mapping[str, Array], weights: Mapping[str, Any]) -> Array:
    """Return the reward (B,): weighted terms of solved cases, weighted violation of the others.

    Args:
        terms: unweighted terms from `evaluate_actions`.
        weights: weight of each term, () or (B,).
    """
    good = sum(weights[name] * terms[name] for name in _GATED)
    bad = weights["violation"] * terms["violation"]
    return jnp.where(terms["solved"] > 0.5, good, bad)
