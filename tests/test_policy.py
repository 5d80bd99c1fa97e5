"""Learned decisions about the order of catches: valid whatever the weights, and stored exactly."""

import dataclasses
import json
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import traverse_util

import planner_jax as pj
from planner_jax.cli.main import main
from planner_jax.planning.decided import first_choice
from planner_jax.policies.checkpoint import load_checkpoint, save_checkpoint
from planner_jax.policies.networks import NETWORKS
from planner_jax.policies.observation import FEATURES, HANDICAP, PER_TARGET, choice_of, observe
from planner_jax.policies.policy import Policy, policy
from planner_jax.policies.settings import WEIGHTS
from planner_jax.task.catch.decide import beam
from planner_jax.task.catch.estimate import INSTANT, timetable
from planner_jax.task.catch.suites import draw_by_key

NUM = 16
BIAS = "params/Dense_0/bias"


def cases_of(suite: str = "triangle3", **how: Any) -> Any:
    return jax.tree.map(np.asarray, pj.catch.draw(NUM, suite, 5, **how))


@pytest.fixture(scope="module")
def fresh() -> Any:
    seen = jnp.zeros((1, 6, FEATURES))
    return {name: kind().init(jax.random.key(0), seen) for name, kind in NETWORKS.items()}


@pytest.mark.parametrize("network", NETWORKS)
def test_an_untrained_policy_decides_as_greedy_does(network, fresh):
    cases = cases_of()
    untrained = first_choice(Policy(fresh[network], NETWORKS[network]()), cases)
    greedy = first_choice(pj.catch.Greedy(), cases)
    np.testing.assert_array_equal(untrained.order, greedy.order)
    np.testing.assert_allclose(untrained.times, greedy.times, rtol=1e-6)


def test_every_action_is_an_order_and_times_that_rise():
    cases = cases_of(num_targets=6)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (NUM, 6, PER_TARGET))
    tables = jax.jit(jax.vmap(timetable))(cases)
    choices = jax.jit(jax.vmap(choice_of))(cases, tables, jnp.asarray(actions, jnp.float32))
    order, times = np.asarray(choices.order), np.asarray(choices.times)
    np.testing.assert_array_equal(np.sort(order, axis=1), np.tile(np.arange(6), (NUM, 1)))
    assert (np.diff(times, axis=1) >= INSTANT - 1e-5).all() and (times > 0.0).all()
    assert (order[:, :3] < 3).all()
    assert (times[:, :3] <= cases.horizon[:, :1] + 3 * INSTANT).all()


def test_attention_does_not_see_the_order_of_targets_or_absent_ones(fresh):
    network = NETWORKS["attention"]()
    rng = np.random.default_rng(2)  # noise on all weights, as the last layer is zero
    noise = lambda leaf: 0.1 * rng.normal(size=leaf.shape).astype(np.float32)  # noqa: E731
    params = jax.tree.map(lambda leaf: leaf + noise(leaf), fresh["attention"])
    cases = cases_of("hexagon6")
    seen = jax.jit(jax.vmap(lambda case: observe(case, timetable(case))))(cases)
    apply = jax.jit(network.apply)
    numbers = np.asarray(apply(params, seen))
    assert np.ptp(numbers[..., 0]) > 1e-3
    mixed = np.random.default_rng(1).permutation(6)
    np.testing.assert_allclose(apply(params, seen[:, mixed]), numbers[:, mixed], atol=1e-5)
    more = jnp.pad(seen, ((0, 0), (0, 2), (0, 0)))
    np.testing.assert_allclose(apply(params, more)[:, :6], numbers, atol=1e-5)


def test_the_shipped_policy_is_solved_and_confirmed_by_the_referee():
    cases = cases_of()
    assert pj.catch.judge(cases, pj.plan(pj.catch.planner(decide="policy"), cases)).success.all()


def test_the_policy_of_hurried_targets_keeps_more_deadlines_than_greedy():
    cases = jax.tree.map(np.asarray, pj.catch.draw(128, "rush6", 5))
    named = pj.catch.planner(decide="policy:rush6").decision
    kept = {}
    for name, decision in (("greedy", pj.catch.Greedy()), ("rush6", named)):
        choice = first_choice(decision, cases)
        left = np.take_along_axis(cases.horizon, np.asarray(choice.order), 1) - choice.times
        kept[name] = float((left >= 0.0).all(axis=1).mean())
    assert kept["rush6"] >= kept["greedy"] + 0.2, kept


def test_a_lane_of_nan_spoils_no_other():
    cases = cases_of()
    planner = pj.catch.planner(decide="policy")
    whole = pj.plan(planner, cases)
    head = np.array(cases.head_state)
    head[3] = np.nan
    broken = dataclasses.replace(cases, head_state=head)
    plans = pj.plan(planner, jax.tree.map(jnp.asarray, broken))
    assert plans.status[3] == pj.Status.BAD_INPUT
    others = np.arange(NUM) != 3
    np.testing.assert_array_equal(plans.times[others], whole.times[others])


def test_of_several_proposals_the_earliest_stays():
    cases = cases_of()
    one = pj.plan(pj.catch.planner(decide=policy()), cases)
    some = pj.plan(pj.catch.planner(decide=policy(proposals=3)), cases)
    assert pj.are_solved(some).all()
    assert (some.times[:, -1] <= 1.001 * one.times[:, -1]).all()


def test_a_search_of_width_one_is_greedy_with_the_same_handicaps():
    cases = cases_of("swarm12")
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (NUM, 12, PER_TARGET))
    actions = jnp.asarray(actions * [1.0, 0.0], jnp.float32)

    @jax.jit
    @jax.vmap
    def by_both(case, action):
        table = timetable(case)
        searched = beam(case, table, 1, handicap=HANDICAP * action[:, 0])
        return choice_of(case, table, action), pj.take(searched, 0)

    greedy, searched = by_both(cases, actions)
    np.testing.assert_array_equal(greedy.taken, searched.taken)
    where = np.take_along_axis(np.asarray(greedy.taken), np.asarray(greedy.order), axis=1)
    np.testing.assert_array_equal(greedy.order[where], searched.order[where])
    np.testing.assert_allclose(greedy.times[where], searched.times[where], rtol=1e-5)


def test_of_optional_targets_a_wider_search_finds_more():
    cases = jax.tree.map(np.asarray, pj.catch.draw(64, "swarm12", 5))
    one, usual = (
        np.asarray(first_choice(decision, cases).present).sum(axis=1).mean()
        for decision in (policy(width=1), policy())
    )
    assert usual >= 1.04 * one


def test_a_checkpoint_gives_back_what_was_saved(tmp_path, fresh):
    for name, params in fresh.items():
        path = tmp_path / name
        save_checkpoint(path, params, NETWORKS[name](), {"suites": ["triangle3"]})
        found = load_checkpoint(path)
        assert found.network == NETWORKS[name]() and found.about["suites"] == ["triangle3"]
        for key, leaf in traverse_util.flatten_dict(found.params, sep="/").items():
            np.testing.assert_array_equal(leaf, traverse_util.flatten_dict(params, sep="/")[key])
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(fresh)


def test_a_file_that_is_no_checkpoint_is_named(tmp_path, fresh):
    missing, torn, other, odd = (tmp_path / name for name in ("none", "torn", "other", "odd"))
    save_checkpoint(torn, fresh["mlp"], NETWORKS["mlp"](), {})
    torn.write_bytes(torn.read_bytes()[:-100])
    save_checkpoint(other, fresh["mlp"], NETWORKS["mlp"](), {"format": 99})
    save_checkpoint(odd, fresh["mlp"], NETWORKS["mlp"](), {"sizes": {"depth": 9}})
    says = {missing: "none", torn: "torn", other: "format 99", odd: "'mlp'.* got depth"}
    for path, words in says.items():
        with pytest.raises(pj.ArgumentError, match=words):
            load_checkpoint(path)


@pytest.mark.parametrize(
    ("entries", "rule"),
    [
        ({"features": None}, "be of format 2 with 38 features"),
        ({"sizes": 3}, "be one that .* wrote, got .*TypeError"),
        ({"sizes": [1]}, "be one that .* wrote, got .*TypeError"),
        ({"sizes": None}, "be one that .* wrote, got .*TypeError"),
        ({"sizes": {"width": "64"}}, "be among size, width, .* got width '64'"),
        ({"sizes": {"width": True}}, "be among size, width, .* got width True"),
        ({"sizes": {"width": 10**9}}, "be among size, width, whole numbers from 1 to 1024"),
        ({"sizes": {"width": 32}}, r"have \(228, 32\) finite numbers in the weight"),
        ({"network": ["mlp"]}, r"be one of attention, mlp, published, got \['mlp'\]"),
        ({"network": "attention"}, "be among width, heads, layers, .* got size 6"),
        ({"network": "attention", "sizes": {}}, "hold the weight"),
        ({"network": "attention", "sizes": {"heads": 5}}, "be of a network that exists"),
        ({"network": "attention", "sizes": {"layers": 33}}, "be among .* at most 32 layers"),
    ],
)
def test_entries_that_do_not_fit_a_network_are_refused(tmp_path, fresh, entries, rule):
    path = tmp_path / "policy"
    save_checkpoint(path, fresh["mlp"], NETWORKS["mlp"](), {})
    about = edit_checkpoint(path)
    assert_refused(path, rule, about=np.array(json.dumps(about | entries)))
    del about["features"]
    assert_refused(path, "be one that .* wrote, got .*KeyError", about=np.array(json.dumps(about)))


def edit_checkpoint(path, **arrays):
    """Replace arrays of a checkpoint, or remove those that are None; return its `about`."""
    with np.load(path) as file:
        found = {**file, **arrays}
    with path.open("wb") as file:
        np.savez(file, **{name: each for name, each in found.items() if each is not None})
    return json.loads(str(found["about"])) if "about" not in arrays else {}


def assert_refused(path, rule, **arrays):
    edit_checkpoint(path, **arrays)
    with pytest.raises(pj.ArgumentError, match=f"must {rule}") as caught:
        load_checkpoint(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arrays", "rule"),
    [
        ({BIAS: None}, f"hold the weight {BIAS}, got"),
        ({f"{BIAS}/more": np.ones(3)}, f"not hold the weight {BIAS}/more, got"),
        ({BIAS: np.full(64, np.nan)}, r"have \(64,\) finite numbers in .* that are not in"),
        ({BIAS: np.ones(64, int)}, r"have \(64,\) finite numbers in .* got int64"),
        ({BIAS: np.ones(63)}, r"have \(64,\) finite numbers in .* got float64 \(63,\)"),
        ({"about": np.ones(3)}, "be one that .* wrote, got .*ValueError"),
        ({"about": np.array("[" * 9999)}, "be one that .* wrote, got .*RecursionError"),
        ({"about": None}, "be one that .* wrote, got .*KeyError"),
    ],
)
def test_weights_that_are_not_finite_or_not_of_the_network_are_refused(
    tmp_path, fresh, arrays, rule
):
    save_checkpoint(tmp_path / "policy", fresh["mlp"], NETWORKS["mlp"](), {})
    assert_refused(tmp_path / "policy", rule, **arrays)


def test_more_targets_than_a_network_takes_are_refused(fresh):
    few = Policy(fresh["mlp"], NETWORKS["mlp"]())
    with pytest.raises(ValueError, match="up to 6 targets and takes no more, got 7"):
        pj.plan(pj.catch.planner(decide=few), cases_of(num_targets=7))


@pytest.mark.parametrize(
    "given, says",
    [
        (["--network", "deep"], "--network must be attention or mlp, got 'deep'"),
        (["--learning-rate", "0"], "--learning-rate must be > 0 and at most 1, got 0"),
        (["--suite", "triangle3", "--init-from", "nowhere.npz"], "that `planner-jax train` wrote"),
    ],
)
def test_bad_settings_of_a_training_are_a_line(given, says, capsys, tmp_path):
    assert main(["train", *given, "--out", str(tmp_path / "run")]) == 2
    (line,) = [x for x in capsys.readouterr().err.splitlines() if "warp" not in x]
    assert says in line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("suite", ["parabola2", "harmonic2", "hexagon6"])
def test_cases_drawn_by_a_key_are_of_the_suites_distribution(suite):
    by_key = jax.jit(draw_by_key, static_argnums=(1, 2))(jax.random.key(1), 4000, suite)
    drawn = pj.catch.draw(4000, suite, 3)
    chex.assert_trees_all_equal_shapes_and_dtypes(by_key, drawn)
    for a, b in zip(jax.tree.leaves(by_key), jax.tree.leaves(drawn), strict=True):
        a, b = np.asarray(a, float), np.asarray(b, float)
        spread = b.std(axis=0) + 1e-6
        assert (np.abs(a.mean(axis=0) - b.mean(axis=0)) < 0.09 * spread + 1e-5).all()
        assert (np.abs(a.std(axis=0) - b.std(axis=0)) < 0.09 * spread + 1e-5).all()


def test_a_reward_pays_early_catches_only_where_they_are_made():
    environment = pytest.importorskip("planner_jax.policies.environment", exc_type=ImportError)
    names = ("solved", "last", "ratio", "caught", "violation")
    terms = jnp.array([[1.0, 0.1, 0.05, 0.0, 0.0], [0.0, 0.9, 0.0, 0.5, 1.0]])
    reward = environment.weight_terms(dict(zip(names, terms.T, strict=True)), WEIGHTS)
    np.testing.assert_allclose(reward, [1.0 + 0.5 - 0.25, -0.5])


def test_actions_are_evaluated_relative_to_the_greedy_decision():
    environment = pytest.importorskip("planner_jax.policies.environment", exc_type=ImportError)
    cases = jax.tree.map(jnp.asarray, pj.catch.draw(4, "parabola1", 5))
    stretch = np.array([0.0, -0.1, -0.2, -0.4], np.float32)  # times factors exp(stretch / 2)
    actions = jnp.stack([jnp.zeros(4), stretch], axis=-1)[:, None]
    terms = environment.evaluate_actions(cases, actions, iterations=0)
    np.testing.assert_allclose(terms["last"], 1.0 - np.exp(0.5 * stretch), atol=1e-6)
    for name in ("ratio", "caught"):
        np.testing.assert_array_equal(terms[name], 0.0)
    # The estimate misses a target that must be caught before the robot can be there.
    assert terms["solved"][0] and terms["violation"][0] == 0.0
    assert not terms["solved"][3] and terms["violation"][3] > 0.0


def test_a_sweep_says_which_policy_decided(tmp_path):
    path = tmp_path / "mine.npz"
    save_checkpoint(path, policy().params, policy().network, {})
    arguments = ["sweep", "catch", "--suite", "triangle3", "--num", str(NUM), "--batch", str(NUM)]
    assert main([*arguments, "--decide", f"policy:{path}", "--out", str(tmp_path / "run")]) == 0
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    said = manifest["planner"]["decision"]
    assert said["class"] == "Policy" and said["network"]["layers"] == 2
    weights = jax.tree.leaves(policy().params)
    assert said["params"]["weights"] == sum(leaf.size for leaf in weights)
    assert manifest["summary"]["success_rate"] == 1.0
