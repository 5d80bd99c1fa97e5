"""Compare this library's training of policies with PPO of Stable-Baselines3.

    python -m benchmarks.policy_peer [--suite triangle3] [--decisions 150000] [--seeds 3]
        [--num 1000] [--seed 777] [--out DIR]

The benchmark needs `pip install stable-baselines3`, in an environment without the extra `gpu`.
PyTorch needs other versions of the CUDA libraries than JAX, so no extra of this library contains
it.

Both trainings use the same environment, in which a policy decides in which order and when a
quadrotor catches several balls. They train the network of [Yu2023catch], two hidden layers of 64
units with ReLU, in 100 environments at once, with the same number of decisions and the same
rewards. Every 100 decisions are used in four passes of four minibatches. In the table, "sb3" is PPO
of Stable-Baselines3. It clips Gaussian actions to -1 and 1, normalises advantages in each
minibatch, and has a value network of the same size and a learning rate of 3e-4. "brax" is this
library's training. It adapts the learning rate to the divergence between the old and the new
policy.

Each policy decides by the mean of its action, on cases of a seed that no training uses. The planner
`exact` plans these cases, and the referee, an independent check in float64, judges the plans. The
table has the minimum and the maximum over training seeds. Training times include compilation.
"""

import argparse
import functools
import importlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

import planner_jax as pj
from planner_jax.benchmarks.policy_ablations import (
    ITERATIONS,
    judge_decision,
    report_seeds,
    train_policy,
    training_settings,
)
from planner_jax.benchmarks.run import Bench, argument_parser, at_least, begin
from planner_jax.policies.environment import CatchEnv
from planner_jax.policies.observation import PER_TARGET, choice_of, observe
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.decide import CatchDecision, in_several_lengths
from planner_jax.task.catch.estimate import timetable
from planner_jax.task.catch.spec import SUITES

torch: Any = importlib.import_module("torch")
spaces: Any = importlib.import_module("gymnasium.spaces")
sb3: Any = importlib.import_module("stable_baselines3")
vec_env: Any = importlib.import_module("stable_baselines3.common.vec_env")

# Number of parallel environments, of minibatches in a pass, and of passes over the same decisions.
LANES, MINIBATCHES, PASSES = 100, 4, 4
FIRST_STD = 0.15  # Standard deviation of actions when Stable-Baselines3 starts its training.


class CatchVecEnv(vec_env.VecEnv):
    """Adapter of the batched environment `CatchEnv` to the interface of Stable-Baselines3."""

    def __init__(self, suite: str, iterations: int, seed: int):
        self.env = CatchEnv((suite,), (iterations,))
        seen = spaces.Box(-np.inf, np.inf, (self.env.observation_size,), np.float32)
        super().__init__(LANES, seen, spaces.Box(-1.0, 1.0, (self.env.action_size,), np.float32))
        self._keys = jax.random.split(jax.random.key(seed), LANES)
        self._reset, self._step = jax.jit(self.env.reset), jax.jit(self.env.step)

    def reset(self) -> np.ndarray:
        """Draw a case for each of 100 environments; return F observed numbers of each, (100, F)."""
        self._state = self._reset(self._keys)
        return np.array(self._state.obs)

    def step_async(self, actions: np.ndarray) -> None:
        """Plan all cases with the policy's actions, A numbers for each; draw the next cases."""
        self._state = self._step(self._state, jnp.asarray(actions, jnp.float32))

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Return observations of the next cases, rewards, flags of ended episodes, and empty infos.

        Every episode ends after one step, because it has a single decision.
        """
        seen, reward = np.array(self._state.obs), np.array(self._state.reward)
        return seen, reward, np.ones(LANES, bool), [{} for _ in range(LANES)]

    def close(self) -> None:
        """Do nothing, because the environment has no open resources."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environment, once for each of 100 parallel environments."""
        return [getattr(self.env, attr_name, None)] * LANES

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Do nothing, because the environment has no settings that can change."""

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Do nothing, because PPO calls no method of the environment by name."""

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for each environment: no wrapper class is used."""
        return [False] * LANES


@struct.dataclass
class PeerPolicy(CatchDecision):
    """Decision of order and times by the mean action of a policy from Stable-Baselines3."""

    layers: Sequence[tuple[Any, Any]]  # weights and biases; ReLU follows all layers but the last

    def propose(self, case: CatchCase) -> CatchChoice:
        """Return the policy's order and times for a case with N targets, arrays (1, N)."""
        table = timetable(case)
        hidden = observe(case, table).ravel()
        *inner, (weights, bias) = self.layers
        for own, shift in inner:
            hidden = jax.nn.relu(_affine(own, shift, hidden))
        action = jnp.clip(_affine(weights, bias, hidden), -1.0, 1.0)
        choice = choice_of(case, table, action.reshape(-1, PER_TARGET))
        return in_several_lengths(case, jax.tree.map(lambda leaf: leaf[None], choice))


def _affine(weights: Any, bias: Any, hidden: jax.Array) -> jax.Array:
    return jnp.matmul(weights, hidden, precision=jax.lax.Precision.HIGHEST) + bias


def train_peer(suite: str, decisions: int, seed: int) -> PeerPolicy:
    """Train a policy on a suite of catches with Stable-Baselines3, with `decisions` decisions."""
    network = {
        "net_arch": [64, 64],
        "activation_fn": torch.nn.ReLU,
        "log_std_init": float(np.log(FIRST_STD)),
    }
    model = sb3.PPO(
        "MlpPolicy",
        CatchVecEnv(suite, ITERATIONS, seed),
        learning_rate=3e-4,
        n_steps=1,
        batch_size=LANES // MINIBATCHES,
        n_epochs=PASSES,
        gamma=0.0,
        ent_coef=1e-4,
        policy_kwargs=network,
        seed=seed,
        device="cpu",
    )
    model.learn(decisions)
    linear = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    layers = [layer for layer in linear if isinstance(layer, torch.nn.Linear)]
    return PeerPolicy(
        [(x.weight.detach().numpy().copy(), x.bias.detach().numpy().copy()) for x in layers]
    )


def train_own(suite: str, decisions: int, seed: int) -> Any:
    """Train a policy on a suite of catches with this library, with `decisions` decisions."""
    return train_policy(
        training_settings(
            suite,
            decisions,
            seed,
            network="mlp",
            num_envs=LANES,
            minibatches=MINIBATCHES,
            updates=PASSES,
        )
    )


def measure(bench: Bench, options: argparse.Namespace) -> None:
    bench.say(
        f"{options.suite}, {options.decisions:,} decisions, {options.seeds} seeds, judged on "
        f"{options.num} cases of seed {options.seed}, {jax.devices()[0]}",
        "| training | refereed | last catch | OTR | time |",
        "|---|---|---|---|---|",
    )
    greedy = judge_decision(bench, pj.catch.Greedy(), options.suite, options)
    bench.row(training="none", **greedy)
    bench.say(
        f"| none: `greedy` | {greedy['success']:.1f} % | {greedy['last']:.3f} s "
        f"| {greedy['ratio']:.3f} | |"
    )
    for name, train_by in (("sb3", train_peer), ("brax", train_own)):
        of_seed = functools.partial(train_by, options.suite, options.decisions)
        report_seeds(bench, {"training": name}, of_seed, options)


def main() -> None:
    parser = argument_parser("policy_peer", __doc__, num=1000, seed=777, seeds=3)
    parser.add_argument("--suite", default="triangle3", choices=SUITES, help="default: triangle3")
    parser.add_argument(
        "--decisions",
        type=at_least(1000),
        default=150_000,
        metavar="N",
        help="decisions in training; default: 150,000",
    )
    options = parser.parse_args()
    with begin(parser, options) as bench:
        measure(bench, options)


if __name__ == "__main__":
    main()
