"""Training by Brax's PPO [Schulman2017; Yu2023catch, eqs 5 and 7]: in parts, so that it can go on.

A run is a row of parts, each one call of `brax.training.agents.ppo.train` from the weights of the
last, with rewards by the planner or by the estimate. What a part leaves is kept by Orbax before
the next one begins, and the seed of a part follows from the run's and its number: a run that was
interrupted goes on to the same weights, bit for bit. Adam's moments start anew with each part,
since Brax does not return them. `progress` says how a run is watched, and `curves` draws it.
"""

import dataclasses
import functools
import json
import math
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.training import networks as brax_networks
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as ppo
from brax.training.distribution import NormalTanhDistribution
from jax import Array

from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import solved
from planner_jax.host import signals as stopping
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.planning.plan import plan
from planner_jax.policies import brax_compat
from planner_jax.policies.checkpoint import checkpoint_of, name_and_sizes, save_checkpoint
from planner_jax.policies.curves import draw_curves
from planner_jax.policies.environment import CatchEnv
from planner_jax.policies.kept import KeptParts
from planner_jax.policies.networks import LEAST_STD, NETWORKS, Value
from planner_jax.policies.observation import FEATURES, PER_TARGET
from planner_jax.policies.policy import Policy
from planner_jax.policies.progress import ASKED, Progress, read_asked, reported_terms
from planner_jax.policies.settings import (
    LEARNING_RATE,
    WEIGHTS,
    TrainSettings,
    usual_iterations,
)
from planner_jax.runs.environment import code_digest, installed_version
from planner_jax.runs.manifest import to_write
from planner_jax.runs.run_folder import RunFolder
from planner_jax.task.catch.decide import optimal_time_ratio
from planner_jax.task.catch.default_planner import ExactCatch
from planner_jax.task.catch.suites import draw

_ROWS = 50  # of a part's curve, at most
_JUDGED_SEED = 4242  # of the cases by which a run is watched; no figure of the results is of them


@dataclasses.dataclass(frozen=True)
class Part:
    """One call of PPO."""

    steps: int  # decisions
    iterations: tuple[int, ...] = ()  # of the planner, one a suite; none: the estimate judges
    learning_rate: float = LEARNING_RATE  # to begin with; then as far as the divergence allows


@dataclasses.dataclass(frozen=True)
class Training:
    """What is trained, on what and for how long."""

    suites: tuple[str, ...]
    parts: tuple[Part, ...]
    network: str = "attention"
    seed: int = 0
    num_envs: int = 8190  # decided at once; a multiple of the number of suites
    updates: int = 4  # of all data
    minibatches: int = 6
    divergence: float = 0.01  # wanted of an update, by which the learning rate is set
    entropy: float = 1e-4
    # Of each term, one or one a suite.
    weights: tuple[tuple[str, float | tuple[float, ...]], ...] = tuple(WEIGHTS.items())
    init_from: str | None = None  # a checkpoint by whose weights it begins, or a shipped one's name
    eval_cases: int = 256  # cases of each suite by which it is watched; 0: it is not


def train(training: Training, out: str | os.PathLike, *, progress: bool = True) -> Policy:
    """Train a policy, or go on where an interrupted run of the same folder and settings ended.

    Args:
        training: what is asked for.
        out: folder of the run: `training.json`, `parts/`, `progress.jsonl`, `tensorboard/`,
            `curves.png` after each part, and `policy.npz` in the end.
        progress: show a bar, and a line on every part, on the standard error stream.

    Returns:
        The policy after the last part.

    Raises:
        ArgumentError: the folder is that of a run with other settings or of other code, or another
            process writes it.
        ArgumentError: the one to begin with cannot be read, or is of another network.
    """
    brax_compat.install()
    folder = Path(out)
    network = NETWORKS[training.network]()
    params = _first_params(training, network)  # before anything is written
    with RunFolder(folder).owned():
        _require_same(folder, training)
        return _train_parts(training, folder, network, params, progress)


def _train_parts(
    training: Training, folder: Path, network: Any, params: Any, progress: bool
) -> Policy:
    """All parts that have not been trained yet, from the parameters that the first begins with."""
    keeper = KeptParts(folder / "parts")
    told, begun = Progress(folder, progress), 0
    for number, part in enumerate(training.parts):
        stopping.check()
        decisions = math.prod(_rows_and_updates(part, training.num_envs)) * training.num_envs
        kept = keeper.restored(number, params)
        if kept is not None:
            params = kept
            begun += decisions
            continue
        title = f"part {number + 1} of {len(training.parts)}"
        with told.part(number, title, begun, decisions) as tell:
            if number == 0 and training.eval_cases:
                told.judge(number, 0, judge_policy(training, network, params[1]))
            params = _by_ppo(training, part, number, network, params, tell)
        begun += decisions
        if training.eval_cases:
            suites = judge_policy(training, network, params[1])
            told.judge(number, begun, suites)
            if progress:
                print(f"{title}: {_sentence(suites)}", file=sys.stderr)
        draw_curves([folder], folder / "curves.png")
        keeper.save(number, params)
    about = {"suites": list(training.suites), "seed": training.seed}
    save_checkpoint(folder / "policy.npz", params[1], network, about)
    return Policy(params=params[1], network=network)


def train_as_asked(settings: TrainSettings, out: str | os.PathLike) -> Policy:
    """Train as `planner-jax train` does; arguments and errors of `train`."""
    lanes = settings.num_envs or (510 if jax.default_backend() == "cpu" else 8190)
    minibatches = 6
    step = len(settings.suites) * minibatches  # one share a suite, and even minibatches
    iterations = tuple(map(usual_iterations, settings.suites))
    training = Training(
        suites=settings.suites,
        parts=tuple(
            Part(int(steps), iterations, settings.learning_rate) for steps in settings.decisions
        ),
        network=settings.network,
        seed=settings.seed,
        num_envs=lanes // step * step,
        minibatches=minibatches,
        init_from=settings.init_from,
        eval_cases=settings.eval_cases,
    )
    return train(training, out)


def judge_policy(training: Training, network: Any, params: Any) -> dict[str, Any]:
    """What a policy's decisions are worth, by suite: success, last catch and ratio."""
    decided = DecidedPlanner(ExactCatch(), Policy(params=params, network=network))
    figures = {}
    for suite in training.suites:
        cases: Any = jax.tree.map(np.asarray, draw(training.eval_cases, suite, _JUDGED_SEED))
        plans = plan(decided, cases)
        good = solved(plans)
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


def _require_same(folder: Path, training: Training) -> None:
    """Write down what is trained and by what, or raise `ArgumentError` if the folder has others."""
    asked = json.loads(json.dumps(dataclasses.asdict(training)))
    maker = {"version": str(installed_version("planner-jax")), "code": code_digest()}
    wanted = {**maker, **asked}
    if (folder / ASKED).exists():
        found = read_asked(folder)
        for name, value in wanted.items():
            if found.get(name) != value:
                raise ArgumentError(
                    name, f"{found.get(name)}, as in the run of {str(folder)!r}", value
                )
        return
    RunFolder(folder).write_text(ASKED, json.dumps(to_write(wanted), indent=1) + "\n")


def _first_params(training: Training, network: Any) -> Any:
    """Normaliser, which is not used, and parameters of policy and value."""
    env = _environment(training, training.parts[0])
    one, other = jax.random.split(jax.random.key(training.seed))
    seen = jnp.zeros((1, env.size, FEATURES))
    size = specs.Array((env.observation_size,), jnp.dtype("float32"))
    normaliser = running_statistics.init_state(size)
    own = jax.jit(network.init)(one, seen)
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
    return jax.device_get((normaliser, own, jax.jit(Value().init)(other, seen)))


def _words(network: Any) -> str:
    name, sizes = name_and_sizes(network)
    return f"{name} ({', '.join(f'{field} {size}' for field, size in sizes.items())})"


def _environment(training: Training, part: Part) -> CatchEnv:
    iterations = part.iterations or (0,) * len(training.suites)
    return CatchEnv(training.suites, iterations, dict(training.weights))


def _rows_and_updates(part: Part, lanes: int) -> tuple[int, int]:
    """How many rows the curve of a part has, and updates each of them."""
    wanted = math.ceil(part.steps / lanes)
    each = math.ceil(wanted / _ROWS)
    return math.ceil(wanted / each), each


def _by_ppo(
    training: Training,
    part: Part,
    number: int,
    network: Any,
    params: Any,
    tell: Callable[[int, Mapping[str, Any]], None],
) -> Any:
    """Parameters after one part, NumPy leaves.

    Args:
        training: of the part.
        part: what is asked for.
        number: of the part, by which its seed is made.
        network: of the policy.
        params: before the part.
        tell: called with decisions of the part and their metrics, once a row of the curve.
    """
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
        num_evals=rows + 1,  # the first one before all training
        num_eval_envs=len(training.suites),  # Brax makes them even so
        progress_fn=tell,
    )
    with reported_terms():
        _, found, _ = ppo.train(**how)
    return jax.device_get(found)


def _networks(network: Any, size: int, *_: Any, **__: Any) -> ppo_networks.PPONetworks:
    """Policy and value as Brax has them, on observations that are flat."""
    value = Value()

    def seen(flat: Array) -> Array:
        return flat.reshape(*flat.shape[:-1], size, FEATURES)

    def numbers(_: Any, params: Any, flat: Array) -> Array:
        found = network.apply(params, seen(flat))
        # What is decided about absent targets does not count, and is no surprise.
        found = jnp.where(seen(flat)[..., -1:] > 0.5, found, 0.0)
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
            apply=lambda _, params, flat: value.apply(params, seen(flat)),
        ),
        parametric_action_distribution=NormalTanhDistribution(size * PER_TARGET, min_std=LEAST_STD),
    )
