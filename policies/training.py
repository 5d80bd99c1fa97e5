"""Training of a policy for catches by PPO [Schulman2017; Yu2023catch, eqs 5, 7].

A training consists of parts, after each of which it can be resumed. A part is one call of
`brax.training.agents.ppo.train` that starts from the weights of the previous part. The module
`environment` computes the rewards. Orbax stores the weights after each part. The seed of a part
follows from the seed of the training and the number of the part, so that an interrupted training
ends with bit-identical weights. The moments of Adam start at zero in each part, because Brax does
not return them. The module `progress` records a training, and `curves` draws its learning curves.
"""

import contextlib
import dataclasses
import functools
import io
import json
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # hides the message that Warp is not installed
    import brax  # noqa: F401

from brax.training import networks as brax_networks
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as ppo
from brax.training.distribution import NormalTanhDistribution
from jax import Array

from planner_jax.core.choices import STARTS
from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import are_solved
from planner_jax.host import signals as stopping
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.planning.plan import plan
from planner_jax.policies import brax_compat
from planner_jax.policies.checkpoint import checkpoint_of, name_and_sizes, save_checkpoint
from planner_jax.policies.curves import draw_curves
from planner_jax.policies.environment import CatchEnv
from planner_jax.policies.kept import KeptParts
from planner_jax.policies.networks import LEAST_STD, NETWORKS, PublishedMlp, Value
from planner_jax.policies.observation import FEATURES, PER_TARGET
from planner_jax.policies.policy import Policy
from planner_jax.policies.progress import SETTINGS, Progress, read_settings, report_terms
from planner_jax.policies.published import PAPER_RULE, PublishedPolicy, RewardWeights
from planner_jax.policies.published_env import PublishedEnv, paper_planner, published_networks
from planner_jax.policies.settings import (
    LEARNING_RATE,
    LEAST_TIME,
    NETWORK_NAMES,
    PAPER_DECISIONS,
    PUBLISHED,
    WEIGHTS,
    TrainSettings,
    usual_iterations,
)
from planner_jax.runs.environment import code_digest, find_version
from planner_jax.runs.manifest import to_write
from planner_jax.runs.run_folder import RunFolder
from planner_jax.task.catch.api import judge
from planner_jax.task.catch.decide import CatchDecision, optimal_time_ratio
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.catch.spec import SUITES
from planner_jax.task.catch.suites import draw

_MINIBATCH = 25  # number of decisions in a minibatch of the published policy
_ROWS = 50  # greatest number of rows in the learning curve of one part (call of PPO)
_EVAL_SEED = 4242  # seed of the evaluation cases, which no published figure uses


@dataclasses.dataclass(frozen=True)
class Part:
    """Settings of one part of a training, that is, of one call of Brax's PPO."""

    steps: int  # number of decisions
    # Number of planner iterations for each suite. If it is empty, rewards come from an estimate of
    # how far the quadrotor misses the targets; the published policy then has the usual iterations.
    iterations: tuple[int, ...] = ()
    # Learning rate at the start of the part. PPO adapts it to the KL divergence of the updates.
    learning_rate: float = LEARNING_RATE


@dataclasses.dataclass(frozen=True)
class Training:
    """All settings of a training, which are stored in `training.json`."""

    suites: tuple[str, ...]  # names of the suites from which cases are drawn
    parts: tuple[Part, ...]
    network: str = "attention"  # key of `networks.KINDS`
    starts: str = STARTS[0]  # states of the quadrotor at time 0: "hover" or "random"
    t_min: float = LEAST_TIME  # [s], least time of a catch by the published policy
    seed: int = 0  # seed of initial weights and cases
    num_envs: int = 8190  # number of cases in parallel; a multiple of the number of suites
    updates: int = 4  # number of passes over each batch of decisions
    minibatches: int = 6  # number of minibatches into which a pass divides the batch
    divergence: float = 0.01  # desired KL divergence of an update, which adapts the learning rate
    entropy: float = 1e-4  # weight of the entropy bonus in the loss of PPO
    # Weights of the reward terms by name: one number, or one number for each entry of `suites`. Of
    # the published policy, the fields of `RewardWeights`.
    weights: tuple[tuple[str, float | tuple[float, ...]], ...] = tuple(WEIGHTS.items())
    init_from: str | None = None  # file or name of a policy with the initial weights
    eval_cases: int = 256  # number of cases of each suite in an evaluation; 0 for no evaluation


def train(training: Training, out: str | os.PathLike, *, progress: bool = True) -> CatchDecision:
    """Train a policy for the order and times of catches, or resume the run in a folder.

    Args:
        training: settings of the training.
        out: folder of the run. It gets `training.json`, `parts/`, `progress.jsonl`, `tensorboard/`,
            `curves.png` after each part, and `policy.npz` with the weights at the end.
        progress: whether to show a progress bar, and a line after each part, on standard error.

    Returns:
        The policy after the last part.

    Raises:
        ArgumentError: the folder holds a run with other settings or other code, another process
            writes to the folder, or the initial checkpoint cannot be read or has another network.
    """
    brax_compat.install()
    folder = Path(out)
    network = _network(training)
    params = _first_params(training, network)  # before anything is written
    with RunFolder(folder).lock():
        _record_settings(folder, training)
        return _train_parts(training, folder, network, params, progress)


def _train_parts(
    training: Training, folder: Path, network: Any, params: Any, progress: bool
) -> CatchDecision:
    keeper = KeptParts(folder / "parts")
    rows, before = Progress(folder, progress), 0
    for number, part in enumerate(training.parts):
        stopping.check()
        decisions = math.prod(_rows_and_updates(part, training.num_envs)) * training.num_envs
        kept = keeper.restore(number, params)
        if kept is not None:
            params = kept
            before += decisions
            continue
        title = f"part {number + 1} of {len(training.parts)}"
        with rows.part(number, title, before, decisions) as tell:
            if number == 0 and training.eval_cases:
                rows.add_evaluation(number, 0, evaluate_policy(training, network, params[1]))
            params = _train_part(training, part, number, network, params, tell)
        before += decisions
        if training.eval_cases:
            suites = evaluate_policy(training, network, params[1])
            rows.add_evaluation(number, before, suites)
            if progress:
                print(f"{title}: {_sentence(suites)}", file=sys.stderr)
        draw_curves([folder], folder / "curves.png")
        keeper.save(number, params)
    about = {"suites": list(training.suites), "seed": training.seed, "starts": training.starts}
    if training.network == PUBLISHED:
        about["t_min"] = training.t_min
    save_checkpoint(folder / "policy.npz", params[1], network, about)
    return _decision(training, network, params[1])


def _network(training: Training) -> Any:
    if training.network == PUBLISHED:
        return PublishedMlp(SUITES[training.suites[0]].num_targets)
    return NETWORKS[training.network]()


def _decision(training: Training, network: Any, params: Any) -> CatchDecision:
    if training.network == PUBLISHED:
        return PublishedPolicy(params, network, training.t_min)
    return Policy(params=params, network=network)


def published_training(
    suite: str, decisions: Sequence[float] = (PAPER_DECISIONS,), num_envs: int = 100, **others: Any
) -> Training:
    """Return the training of the published policy for one suite [Yu2023catch, Section IV-B].

    Args:
        suite: name of the suite, without optional targets.
        decisions: number of decisions of each part.
        num_envs: number of cases in parallel, a multiple of 25, the size of a minibatch.
        others: further fields of `Training`, and the fields of `Part` other than `steps`.
    """
    own = {name: others.pop(name) for name in ("iterations", "learning_rate") if name in others}
    return Training(
        suites=(suite,),
        parts=tuple(Part(int(steps), **own) for steps in decisions),
        network=PUBLISHED,
        num_envs=num_envs,
        minibatches=num_envs // _MINIBATCH,
        weights=tuple(dataclasses.asdict(RewardWeights()).items()),
        **others,
    )


def train_from_settings(settings: TrainSettings, out: str | os.PathLike) -> CatchDecision:
    """Train a policy with the options of `planner-jax train`; calls `train`."""
    given = {name: getattr(settings, name) for name in ("seed", "init_from", "eval_cases")}
    given["starts"] = settings.first_states
    if settings.policy == PUBLISHED:
        lanes = (settings.num_envs or 100) // _MINIBATCH * _MINIBATCH
        given["learning_rate"] = settings.learning_rate
        return train(published_training(settings.suite, settings.parts, lanes, **given), out)
    lanes = settings.num_envs or (510 if jax.default_backend() == "cpu" else 8190)
    minibatches = 6
    # The cases are divided evenly among the suites and among the minibatches.
    step = len(settings.suites) * minibatches
    iterations = tuple(map(usual_iterations, settings.suites))
    training = Training(
        suites=settings.suites,
        parts=tuple(
            Part(int(steps), iterations, settings.learning_rate) for steps in settings.parts
        ),
        network=settings.network or NETWORK_NAMES[0],
        num_envs=lanes // step * step,
        minibatches=minibatches,
        **given,
    )
    return train(training, out)


def evaluate_policy(training: Training, network: Any, params: Any) -> dict[str, Any]:
    """Plan `eval_cases` cases of each suite from a policy's decisions; return results by suite.

    The results are the success rate, and means over solved cases: the time [s] of the last catch,
    the optimal time ratio (relative difference of decided and planned catch times), iterations.
    The published policy is evaluated with the planner and the rule of success of its paper.
    """
    published = training.network == PUBLISHED
    planner = paper_planner() if published else CatchProblem.planner()
    decided = DecidedPlanner(planner, _decision(training, network, params))
    figures = {}
    for suite in training.suites:
        drawn = draw(training.eval_cases, suite, _EVAL_SEED, starts=training.starts)
        cases: Any = jax.tree.map(np.asarray, drawn)
        plans = plan(decided, cases)
        good = judge(cases, plans, **PAPER_RULE).success if published else are_solved(plans)
        figures[suite] = {
            "success": float(good.mean()),
            "last": float(plans.times[good, -1].mean()) if good.any() else None,
            "ratio": float(optimal_time_ratio(cases, plans)[good].mean()) if good.any() else None,
            "iterations": float(plans.iterations[good].mean()) if good.any() else None,
        }
    return figures


def _sentence(suites: Mapping[str, Any]) -> str:
    words = []
    for name, found in suites.items():
        words.append(f"{name} {100.0 * found['success']:.1f} % solved")
        if found["last"] is not None:
            words[-1] += f", last catch {found['last']:.3f} s, ratio {found['ratio']:.3f}"
    return "; ".join(words)


def _record_settings(folder: Path, training: Training) -> None:
    asked = json.loads(json.dumps(dataclasses.asdict(training)))
    maker = {"version": str(find_version("planner-jax")), "code": code_digest()}
    wanted = {**maker, **asked}
    if (folder / SETTINGS).exists():
        found = read_settings(folder)
        for name, value in wanted.items():
            if found.get(name) != value:
                raise ArgumentError(
                    name, f"{found.get(name)}, as in the run of {str(folder)!r}", value
                )
        return
    RunFolder(folder).write_text(SETTINGS, json.dumps(to_write(wanted), indent=1) + "\n")


def _first_params(training: Training, network: Any) -> Any:
    env = _environment(training, training.parts[0])
    nets = _networks(network, env.size)
    one, other = jax.random.split(jax.random.key(training.seed))
    size = specs.Array((env.observation_size,), jnp.dtype("float32"))
    normaliser = running_statistics.init_state(size)
    own = jax.jit(nets.policy_network.init)(one)
    if training.init_from is not None:
        given = checkpoint_of(training.init_from)
        if given.network != network:
            raise ArgumentError(
                "init_from",
                f"the weights of {_words(network)}",
                verb="hold",
                shown=_words(given.network),
            )
        own = given.params
    return jax.device_get((normaliser, own, jax.jit(nets.value_network.init)(other)))


def _words(network: Any) -> str:
    name, sizes = name_and_sizes(network)
    return f"{name} ({', '.join(f'{field} {size}' for field, size in sizes.items())})"


def _environment(training: Training, part: Part) -> CatchEnv:
    weights: dict[str, Any] = dict(training.weights)
    if training.network == PUBLISHED:
        planner, own = paper_planner(*part.iterations), RewardWeights(**weights)
        return PublishedEnv(training.suites[0], planner, training.t_min, own, training.starts)
    iterations = part.iterations or (0,) * len(training.suites)
    return CatchEnv(training.suites, iterations, weights, training.starts)


def _rows_and_updates(part: Part, lanes: int) -> tuple[int, int]:
    wanted = math.ceil(part.steps / lanes)
    each = math.ceil(wanted / _ROWS)
    return math.ceil(wanted / each), each


def _train_part(
    training: Training,
    part: Part,
    number: int,
    network: Any,
    params: Any,
    tell: Callable[[int, Mapping[str, Any]], None],
) -> Any:
    """Run one part (call of PPO) of a training; return its final parameters as NumPy arrays."""
    env = _environment(training, part)
    rows, each = _rows_and_updates(part, training.num_envs)
    how: dict[str, Any] = dict(
        environment=env,
        num_timesteps=rows * each * training.num_envs,
        wrap_env=False,
        num_envs=training.num_envs,
        episode_length=1,
        learning_rate=part.learning_rate,
        learning_rate_schedule="ADAPTIVE_KL",
        learning_rate_schedule_max_lr=1e-3,
        desired_kl=training.divergence,
        entropy_cost=training.entropy,
        discounting=0.0,
        unroll_length=1,
        batch_size=training.num_envs // training.minibatches,
        num_minibatches=training.minibatches,
        num_updates_per_batch=training.updates,
        clipping_epsilon=0.2,
        max_grad_norm=1.0,
        network_factory=functools.partial(_networks, network, env.size),
        seed=training.seed * 1000 + number,
        restore_params=params,
        run_evals=False,
        num_evals=rows + 1,  # Brax counts an evaluation before the training, too
        num_eval_envs=len(training.suites),  # Brax creates them even with run_evals=False
        progress_fn=tell,
    )
    with report_terms():
        _, found, _ = ppo.train(**how)
    return jax.device_get(found)


def _networks(network: Any, size: int, *_: Any, **__: Any) -> ppo_networks.PPONetworks:
    if isinstance(network, PublishedMlp):
        return published_networks(network)
    value = Value()

    def unflatten(flat: Array) -> Array:
        return flat.reshape(*flat.shape[:-1], size, FEATURES)

    def numbers(_: Any, params: Any, flat: Array) -> Array:
        found = network.apply(params, unflatten(flat))
        # Give absent targets constant distributions of actions. They then add nothing to the KL
        # divergence, by which PPO adapts its learning rate.
        found = jnp.where(unflatten(flat)[..., -1:] > 0.5, found, 0.0)
        means, spreads = found[..., :PER_TARGET], found[..., PER_TARGET:]
        shape = (*flat.shape[:-1], -1)
        return jnp.concatenate([means.reshape(shape), spreads.reshape(shape)], axis=-1)

    one = jnp.zeros((1, size, FEATURES))
    kind: Any = ppo_networks.PPONetworks
    return kind(
        policy_network=brax_networks.FeedForwardNetwork(
            init=lambda key: network.init(key, one), apply=numbers
        ),
        value_network=brax_networks.FeedForwardNetwork(
            init=lambda key: value.init(key, one),
            apply=lambda _, params, flat: value.apply(params, unflatten(flat)),
        ),
        parametric_action_distribution=NormalTanhDistribution(size * PER_TARGET, min_std=LEAST_STD),
    )
