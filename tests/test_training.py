"""Training of policies: they improve, and training continues bit for bit after interruptions."""

import dataclasses
import json
import sys
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.cli.main import main
from planner_jax.core.errors import ArgumentError
from planner_jax.core.missing_extra import install_line
from planner_jax.planning.decided import first_choice
from planner_jax.policies.checkpoint import load_checkpoint, save_checkpoint
from planner_jax.policies.curves import draw_curves
from planner_jax.policies.networks import NETWORKS, Mlp
from planner_jax.policies.observation import FEATURES
from planner_jax.policies.policy import Policy, policy
from planner_jax.policies.progress import FILE, read_rows, to_text
from planner_jax.policies.settings import NETWORK_NAMES
from planner_jax.runs.manifest import to_write
from planner_jax.task.catch.estimate import shortfall
from planner_jax.task.catch.suites import draw_by_key

training = pytest.importorskip("planner_jax.policies.training", exc_type=ImportError)
published_env = pytest.importorskip("planner_jax.policies.published_env", exc_type=ImportError)
SUITE, LANES, ROWS = "triangle3", 250, 50
PART = training.Part(steps=ROWS * LANES, learning_rate=1e-3)


@pytest.fixture(scope="module")
def hasty() -> Policy:
    network = Mlp()
    params: Any = network.init(jax.random.key(0), jnp.zeros((1, 3, FEATURES)))
    params = jax.tree.map(np.array, params)
    params["params"]["Dense_3"]["bias"][1] = -0.6
    return Policy(params, network)


@pytest.fixture(scope="module")
def asked(hasty, tmp_path_factory) -> Any:
    path = tmp_path_factory.mktemp("hasty") / "hasty.npz"
    save_checkpoint(path, hasty.params, hasty.network, {})
    sizes = {"num_envs": LANES, "minibatches": 5, "eval_cases": 0}
    options = {"network": "mlp", "divergence": 0.05, "init_from": str(path)}
    return training.Training((SUITE,), (PART,), **sizes, **options)


@pytest.fixture(scope="module")
def trained(asked, tmp_path_factory) -> Any:
    out = tmp_path_factory.mktemp("trained")
    return training.train(asked, out, progress=False), out


@pytest.fixture(scope="module")
def published(tmp_path_factory) -> Any:
    """Train the published policy in cases that weight the change of the decided times most."""
    out = tmp_path_factory.mktemp("published")
    how: dict[str, Any] = {"iterations": (5,), "learning_rate": 3e-4}
    asked = training.published_training(
        "parabola1", [6000], 50, starts="random", t_min=0.25, eval_cases=0, **how
    )
    weights = (("caught", 1.0), ("cost", 0.1), ("time", 5.0))
    asked = dataclasses.replace(asked, weights=weights)
    return training.train(asked, out, progress=False), out


def test_training_of_the_published_policy_raises_its_reward(published):
    rewards = [row["reward"] for row in read_rows(published[1])]
    tenth = len(rewards) // 10
    assert np.mean(rewards[-tenth:]) > np.mean(rewards[:tenth]) + 0.3


def test_a_trained_published_policy_is_read_from_its_file(published):
    found = load_checkpoint(published[1] / "policy.npz")
    assert (found.about["starts"], found.about["t_min"]) == ("random", 0.25)
    cases = draw_by_key(jax.random.key(1), 20, "parabola1", "random")
    read = policy(published[1] / "policy.npz")
    choices = [jax.vmap(each.propose)(cases) for each in (read, published[0])]
    chex.assert_trees_all_equal(*choices)
    assert np.ptp(np.asarray(choices[0].times)) > 0.1 and np.min(choices[0].times) >= 0.25


def test_a_case_of_nan_gets_the_least_reward_and_spoils_no_other():
    env = published_env.PublishedEnv("parabola1", published_env.paper_planner(5))
    state = jax.jit(env.reset)(jax.random.split(jax.random.key(0), 50))
    assert state.obs.shape == (50, env.observation_size) == (50, 16)
    action = jnp.zeros((50, env.action_size))
    step = jax.jit(env.step)
    usual = step(state, action)
    (cases,) = state.info["cases"]
    broken = cases.replace(head_state=cases.head_state.at[3].set(jnp.nan))
    spoiled = step(state.replace(info=state.info | {"cases": (broken,)}), action)
    others = np.arange(50) != 3
    assert spoiled.reward[3] == -30.0 and np.isfinite(usual.reward).all()
    np.testing.assert_array_equal(spoiled.reward[others], usual.reward[others])
    solved = np.asarray(usual.info["episode_metrics"]["solved"])
    assert set(solved) == {0.0, 1.0} and usual.done.all()
    assert usual.reward[solved == 1.0].mean() > usual.reward[solved == 0.0].mean()
    assert not np.array_equal(usual.obs, state.obs)


@pytest.mark.parametrize("starts", ["hover", "random"])
def test_the_extended_policy_is_trained_from_the_requested_starts(starts):
    asked = training.Training((SUITE,), (PART,), starts=starts)
    env = training._environment(asked, PART)
    (cases,) = jax.jit(env.reset)(jax.random.split(jax.random.key(0), 4)).info["cases"]
    assert (np.ptp(np.asarray(cases.head_state)[:, 1]) > 0.1) == (starts == "random")


def feasible(found: Policy) -> float:
    cases = draw_by_key(jax.random.key(9), 500, SUITE)
    far = jax.jit(jax.vmap(shortfall))(cases, first_choice(found, cases))
    return float((np.asarray(far) <= 0.0).mean())


def test_training_makes_feasible_decisions_common(hasty, trained):
    assert feasible(hasty) < 0.05
    assert feasible(trained[0]) >= 0.5


def test_a_training_leaves_its_curve(trained):
    _, out = trained
    rows = read_rows(out)
    assert [row["decisions"] for row in rows] == [LANES * (k + 1) for k in range(ROWS)]
    assert rows[-1]["reward"] > rows[0]["reward"] + 0.5
    assert rows[-1]["solved"] > 0.3 and rows[-1]["last"] < 0.0 and rows[-1]["violation"] > 0.0
    assert all((row["last"] is None) == (row["solved"] == 0.0) for row in rows)
    assert (out / "curves.png").stat().st_size > 10_000
    (events,) = (out / "tensorboard").iterdir()
    assert events.stat().st_size > ROWS * 100
    assert not [path for path in out.iterdir() if "tmp" in path.name]


def test_curves_are_drawn_together_of_several_seeds_but_not_of_other_settings(trained, tmp_path):
    _, out = trained
    other = tmp_path / "other"
    other.mkdir()
    asked = json.loads((out / "training.json").read_text())
    (other / FILE).write_text(to_text(read_rows(out)[:-3]))
    (other / "training.json").write_text(json.dumps(to_write({**asked, "seed": 1})))
    draw_curves([out, other], tmp_path / "both.png")
    assert (tmp_path / "both.png").stat().st_size > 10_000
    (other / "training.json").write_text(json.dumps(to_write({**asked, "num_envs": 7})))
    with pytest.raises(ArgumentError, match=f"same num_envs as .*, {LANES}, got 7"):
        draw_curves([out, other], tmp_path / "both.png")
    with pytest.raises(ArgumentError, match="run must be the folder of a training"):
        draw_curves([tmp_path], tmp_path / "both.png")


def test_a_run_of_other_settings_is_not_gone_on_with(asked, trained):
    with pytest.raises(ArgumentError, match="seed must be 0, as in the run of .*, got 1"):
        training.train(dataclasses.replace(asked, seed=1), trained[1])


@pytest.mark.slow
def test_training_goes_on_bit_for_bit_where_it_was_interrupted(asked, tmp_path, monkeypatch):
    asked = dataclasses.replace(asked, parts=(PART, PART))
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    one = training.train(asked, whole, progress=False)
    plain = training._train_part

    def stopping(asked: Any, part: Any, number: int, *others: Any) -> Any:
        *others, tell = others

        def report_or_interrupt(decisions: int, metrics: Any) -> None:
            tell(decisions, metrics)
            if number == 1 and decisions > PART.steps // 2:
                raise KeyboardInterrupt

        return plain(asked, part, number, *others, report_or_interrupt)

    monkeypatch.setattr(training, "_train_part", stopping)
    with pytest.raises(KeyboardInterrupt):
        training.train(asked, cut, progress=False)
    monkeypatch.setattr(training, "_train_part", plain)
    assert ROWS < len(read_rows(cut)) < 2 * ROWS
    (cut / "parts" / "001.orbax-checkpoint-tmp-0").mkdir()
    again = training.train(asked, cut, progress=False)
    chex.assert_trees_all_equal(one.params, again.params)
    kept = [
        [{name: row[name] for name in row if name != "per_second"} for row in read_rows(folder)]
        for folder in (whole, cut)
    ]
    assert kept[0] == kept[1] and len(kept[0]) == 2 * ROWS
    assert len(list((cut / "tensorboard").iterdir())) == 2


@pytest.mark.parametrize(
    "network, begun, says",
    [
        ("attention", Mlp(), "weights of attention (width 64, heads 4, layers 2), got mlp (size 6"),
        ("mlp", Mlp(width=8), "weights of mlp (size 6, width 64), got mlp (size 6, width 8)"),
    ],
)
def test_weights_of_another_network_or_size_are_refused(network, begun, says, capsys, tmp_path):
    path, out = tmp_path / "other.npz", tmp_path / "run"
    params = begun.init(jax.random.key(0), jnp.zeros((1, 3, FEATURES)))
    save_checkpoint(path, params, begun, {})
    given = ["--suite", SUITE, "--network", network, "--init-from", str(path), "--out", str(out)]
    assert main(["train", *given]) == 2
    assert f"--init-from must hold the {says}" in capsys.readouterr().err
    assert not out.exists()


def test_a_training_without_brax_names_the_extra(capsys, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "planner_jax.policies.training")
    for name in ("planner_jax.policies.brax_compat", "brax.training", "brax"):
        monkeypatch.setitem(sys.modules, name, None)
    assert main(["train", "--out", str(tmp_path / "run")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "train needs brax" in line and install_line("policies") in line
    assert not (tmp_path / "run").exists()


def test_every_network_is_named_in_settings():
    assert tuple(NETWORKS) == NETWORK_NAMES
