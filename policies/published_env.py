"""The Brax environment and the networks by which the policy of [Yu2023catch] is trained."""

import contextlib
import dataclasses
import io
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

with contextlib.redirect_stdout(io.StringIO()):  # hides the message that Warp is not installed
    from brax.training import networks as brax_networks
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.distribution import NormalDistribution

from planner_jax.baselines.catch.paper import COST_UNIT, PaperCatch
from planner_jax.optimise.planner import SearchPlanner
from planner_jax.policies.environment import CatchEnv
from planner_jax.policies.networks import PublishedMlp, PublishedValue
from planner_jax.policies.published import (
    USUAL_WEIGHTS,
    RewardWeights,
    count_caught,
    observe_published,
    published_reward,
    times_of,
)
from planner_jax.policies.settings import LEAST_TIME
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.estimate import earliest_next, timetable

_LEAST_REWARD = -30.0  # of plans with undefined numbers, and of all plans that are worse


class PublishedEnv(CatchEnv):
    """The environment of [Yu2023catch, Section IV-B]: one decision is an episode, without physics.

    The planner of the same paper plans from the decided order and times. Its first attempt is made.

    Args:
        suite: name of the suite from which cases are drawn; no target may be left out.
        planner: planner of the problem `PaperCatch`, from `paper_planner`.
        t_min: [s], least time of a catch.
        weights: coefficients of the reward.
        starts: states of the quadrotor at time 0: "hover" or "random", see `draw`.
    """

    def __init__(
        self,
        suite: str,
        planner: SearchPlanner,
        t_min: float = LEAST_TIME,
        weights: RewardWeights = USUAL_WEIGHTS,
        starts: str = "random",
    ):
        super().__init__((suite,), (), starts=starts)
        self.planner, self.t_min, self.reward = planner, t_min, weights

    def _score(self, cases: tuple[CatchCase, ...], action: Array) -> tuple[Array, dict[str, Array]]:
        (drawn,) = cases
        decide = jax.vmap(times_of, (0, None, 0, 0))
        choices = decide(action, self.t_min, drawn.horizon, drawn.present)
        decided = drawn.with_choice(choices)
        plans = self.planner.solve_lanes(decided, self.planner.attempts[0])
        num = jax.vmap(count_caught)(decided, plans)
        total = jnp.sum(drawn.present, axis=1)
        reward = jax.vmap(published_reward, (0, 0, 0, 0, 0, None))(
            num, total, COST_UNIT * plans.cost, choices.times, plans.times, self.reward
        )
        tables = jax.vmap(timetable)(drawn)
        greedy = jax.vmap(earliest_next)(drawn, tables, jnp.zeros_like(drawn.horizon)).times[:, -1]
        off = jnp.abs(plans.times - choices.times) / jnp.maximum(plans.times, 1e-3)
        terms = {
            "solved": num == total,
            "last": (greedy - plans.times[:, -1]) / greedy,
            "ratio": jnp.mean(off, axis=1),
            "caught": num,
            "violation": plans.violation,
        }
        reward = jnp.maximum(jnp.nan_to_num(reward, nan=_LEAST_REWARD), _LEAST_REWARD)
        return reward, {k: jnp.nan_to_num(1.0 * term, nan=2.0) for k, term in terms.items()}

    def _observe(self, cases: tuple[CatchCase, ...]) -> Array:
        return jax.vmap(observe_published)(cases[0])

    @property
    def observation_size(self) -> int:
        """Length of the observation of one case."""
        return PublishedMlp(self.size).features

    @property
    def action_size(self) -> int:
        """Number of components in the action for one case, one for each target."""
        return self.size


def paper_planner(iterations: int | None = None) -> SearchPlanner:
    """Return the planner of [Yu2023catch] with another number of iterations of its last stage.

    None: the usual number, 150. Two shorter stages of 15 and 20 iterations are always made.
    """
    (attempt,) = PaperCatch.attempts
    steps = attempt.solver.max_steps if iterations is None else iterations
    solver = dataclasses.replace(attempt.solver, max_steps=steps)
    return PaperCatch.planner(attempts=(dataclasses.replace(attempt, solver=solver),))


class _FreeDeviation(NormalDistribution):
    """Normal distribution of unbounded actions, from their means and logarithmic deviations."""

    def create_dist(self, parameters: Array) -> Any:
        mean, log_std = jnp.split(parameters, 2, axis=-1)
        return super().create_dist((mean, jnp.exp(log_std)))


def published_networks(network: PublishedMlp) -> ppo_networks.PPONetworks:
    """Return policy and value network for Brax's PPO; the action has no bounds.

    PPO thus computes the probability of the sampled action, before `times_of` clips its times.
    """
    value, seen = PublishedValue(network.width), jnp.zeros((1, network.features))
    kind: Any = ppo_networks.PPONetworks
    policy_network, value_network = (
        brax_networks.FeedForwardNetwork(
            init=lambda key, one=one: one.init(key, seen),
            apply=lambda _, params, flat, one=one: one.apply(params, flat),
        )
        for one in (network, value)
    )
    return kind(policy_network, value_network, _FreeDeviation(network.size))
