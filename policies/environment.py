"""A Brax environment in which a policy learns to decide the order and times of catches.

One step is one decision for one case. Its reward is computed from the plan for which the decision
is the first guess. As in [Yu2023catch, Section IV-B], an episode has one step, and each step draws
new cases.

`reset` takes a batch of keys and `step` a batch of actions, so that one call of the planner solves
all cases. The batch is divided evenly among the suites (families of cases). The suites may have
different numbers of targets.
"""

import contextlib
import io
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

with contextlib.redirect_stdout(io.StringIO()):  # hides the message that Warp is not installed
    from brax.envs.base import Env, State

from planner_jax.core.choices import STARTS
from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import is_solved
from planner_jax.optimise.rows import Group, Table, load_group
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.policies.observation import FEATURES, PER_TARGET, choice_of, observe
from planner_jax.policies.settings import WEIGHTS
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.decide import in_several_lengths
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.catch.estimate import earliest_next, shortfall, timetable
from planner_jax.task.catch.spec import SUITES
from planner_jax.task.catch.suites import draw_by_key

# Terms of the reward that count for solved cases only. If they counted for all cases, a policy
# would be rewarded for early catches that no plan achieves. Unsolved cases get only `violation`.
_GATED = ("solved", "last", "ratio", "caught")


class CatchEnv(Env):
    """An environment that rewards decisions by the planner's results, or by a cheap estimate.

    The planner `CatchProblem` optimises a trajectory for each case from one initial guess, the
    decision. Suites whose cases have equal shapes and equal iterations are planned in one call.

    Args:
        suites: names of the suites (families of cases) from which cases are drawn.
        iterations: number of planner iterations for each suite. For zero, the planner is replaced
            by an estimate of how far a point of bounded acceleration misses the targets.
        weights: weights of the reward terms of `evaluate_actions`, by name. A weight is one number,
            or one number for each suite.
        starts: states of the quadrotor at time 0: "hover" or "random", see `draw`.
    """

    def __init__(
        self,
        suites: tuple[str, ...],
        iterations: tuple[int, ...],
        weights: Mapping[str, float | tuple[float, ...]] = WEIGHTS,
        starts: str = STARTS[0],
    ):
        self.suites, self.iterations, self.starts = tuple(suites), tuple(iterations), starts
        self.weights = {
            name: np.broadcast_to(np.asarray(value, np.float32), len(self.suites))
            for name, value in weights.items()
        }
        self.size = max(SUITES[suite].num_targets for suite in suites)

    def reset(self, rng: Array) -> State:
        """Draw the first cases of B environments, and return their state.

        `rng` are B random keys (B, 2), as Brax passes them; all cases are drawn with the first key.
        B must be a multiple of the number of suites.
        """
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
        """Plan the cases from the policy's actions, compute the rewards, and draw new cases.

        `action` is (B, 2 N) for B cases, two components for each of N targets, where N is the
        greatest number of targets in any suite. Cases with fewer targets ignore the surplus.
        """
        key, own = jax.random.split(state.info["key"])
        num = action.shape[0]
        reward, terms = self._score(state.info["cases"], action)
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

    def _score(self, cases: tuple[CatchCase, ...], action: Array) -> tuple[Array, dict[str, Array]]:
        """Return the rewards (B,) of actions (B, 2 N), and their unweighted terms (B,) by name."""
        actions = action.reshape(len(self.suites), -1, self.size, PER_TARGET)
        terms, share = self._evaluate(cases, actions), action.shape[0] // len(self.suites)
        weights = {k: np.repeat(one, share) for k, one in self.weights.items()}
        return weight_terms(terms, weights), terms

    def _evaluate(self, cases: tuple[CatchCase, ...], actions: Array) -> dict[str, Array]:
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
        keys = zip(jax.random.split(key, len(self.suites)), self.suites, strict=True)
        return tuple(draw_by_key(k, share, suite, self.starts) for k, suite in keys)

    def _observe(self, cases: tuple[CatchCase, ...]) -> Array:
        def of_suite(cases: CatchCase) -> Array:
            seen = jax.vmap(lambda case: observe(case, timetable(case)))(cases)
            absent = self.size - cases.num_targets
            return jnp.pad(seen, ((0, 0), (0, absent), (0, 0)))

        seen = jnp.concatenate([of_suite(some) for some in cases])
        return seen.reshape(len(seen), -1)

    @property
    def observation_size(self) -> int:
        """Number of features in the observation of one case, over all its targets."""
        return self.size * FEATURES

    @property
    def action_size(self) -> int:
        """Number of components in the action for one case, over all its targets."""
        return self.size * PER_TARGET

    @property
    def backend(self) -> str:
        """Name of the physics backend, which Brax requires; there is no physics simulation."""
        return "planner_jax"


def evaluate_actions(cases: CatchCase, actions: Array, iterations: int) -> dict[str, Array]:
    """Return the unweighted reward terms (B,) of the actions for B cases, by name.

    Two terms compare with `Greedy`, the decision that always catches next the target that can be
    caught earliest.

    Args:
        cases: batch of B cases with N targets each.
        actions: (B, N, 2), from -1 to 1 for each target: a handicap in units of 4 s, which delays
            it in the order of catches, and twice the logarithm of a factor on its catch time.
        iterations: number of planner iterations; for zero an estimate is used, not the planner.

    Returns:
        solved: 1 if the plan meets all limits of the case (thrust, body rate, height), else 0.
        last: (t_greedy - t) / t_greedy, where t is the time of the last catch, and t_greedy its
            estimate for the decision `Greedy`; zero in suites with optional targets.
        caught: (n - n_greedy) / n_greedy, where n is the number of targets that the decision
            includes; zero in suites without optional targets.
        ratio: optimal time ratio [Yu2023catch, eq. 29], the mean relative difference of decided and
            planned catch times; zero with the estimate.
        violation: largest relative excess over a limit, at most 2. With the estimate log(1 + d),
            where d [m] is the summed distance by which the quadrotor misses the targets.
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
    # Clip the terms to -2 to 2, and replace NaN by 2. Otherwise one case with huge or undefined
    # terms could spoil a whole update of the policy.
    return {
        name: jnp.clip(jnp.nan_to_num(jnp.asarray(term, jnp.float32), nan=2.0), -2.0, 2.0)
        for name, term in terms.items()
    }


def _plan(cases: CatchCase, choices: CatchChoice, iterations: int) -> tuple[CatchChoice, Any]:
    if not cases.optional:
        decided = cases.with_choice(choices)
        return choices, CatchProblem.planner().solve_lanes(decided, _search(iterations))
    several = jax.vmap(in_several_lengths)(cases, jax.tree.map(lambda x: x[:, None], choices))
    num = several.times.shape[1]
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), several)
    tried = jax.tree.map(lambda leaf: jnp.repeat(leaf, num, axis=0), cases).with_choice(flat)
    found = CatchProblem.planner().solve_lanes(tried, _search(iterations))
    each = jax.tree.map(lambda leaf: leaf.reshape(-1, num, *leaf.shape[1:]), (flat, found))
    # Each decision was also planned without its last catches. These variants are sorted by falling
    # number of catches, so that the first solved variant has the most catches.
    best = jnp.argmax(is_solved(each[1].status), axis=1)
    return jax.tree.map(lambda leaf: leaf[jnp.arange(len(best)), best], each)


def _search(iterations: int) -> Table:
    attempt = Attempt(starts=1, solver=LbfgsConfig(max_steps=iterations))
    return load_group(CatchProblem(), Group.of((attempt,), (0,)))[1]


def weight_terms(terms: Mapping[str, Array], weights: Mapping[str, Any]) -> Array:
    """Return the rewards (B,) of a batch of decisions.

    The reward of a solved case is the weighted sum of its terms without `violation`. The reward of
    an unsolved case is its weighted violation.

    Args:
        terms: unweighted terms (B,) of B decisions, by name: the result of `evaluate_actions`.
        weights: weight of each term, one number or (B,), by name.
    """
    good = sum(weights[name] * terms[name] for name in _GATED)
    bad = weights["violation"] * terms["violation"]
    return jnp.where(terms["solved"] > 0.5, good, bad)
