"""The policy of [Yu2023catch]: its reward, its actions, its observation, its checkpoint."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.optimise.planner import pending
from planner_jax.policies.checkpoint import save_checkpoint
from planner_jax.policies.networks import PublishedMlp
from planner_jax.policies.policy import policy
from planner_jax.policies.published import (
    RewardWeights,
    count_caught,
    observe_published,
    published_reward,
    times_of,
)
from planner_jax.robot.quadrotor import body_z
from planner_jax.task.catch.context import targets_at
from planner_jax.task.catch.estimate import INSTANT
from planner_jax.task.catch.plan import CatchPlan
from planner_jax.trajectory.minco import minco
from planner_jax.trajectory.polynomial import PiecewisePolynomial

NUM = 16
AT = jnp.array([0.5, 1.25, 2.0])
TO = jnp.array([0.75, 1.0, 2.5])


def cases_of(suite: str = "triangle3", **how: Any) -> Any:
    return jax.tree.map(np.asarray, pj.catch.draw(NUM, suite, 5, starts="random", **how))


def decision_of(size: int) -> Any:
    network = PublishedMlp(size)
    return network, network.init(jax.random.key(0), jnp.zeros(network.features))


def test_the_reward_is_the_printed_sum():
    weights = RewardWeights(caught=5.0, cost=0.0, time=0.0)
    for caught, expected in ((0, 0.0), (3, 1.0 - np.exp(-3.0)), (2, np.exp(-1.0) - np.exp(-3.0))):
        reward = published_reward(caught, 3, 1e4, AT, TO, weights)
        np.testing.assert_allclose(reward, 5.0 * expected, rtol=1e-6)
    weights = RewardWeights(caught=5.0, cost=0.3, time=2.0)
    costs = [float(published_reward(2, 3, cost, AT, TO, weights)) for cost in (1e4, 1e4 * np.e)]
    np.testing.assert_allclose(costs[0] - costs[1], 0.3, rtol=1e-5)
    change = published_reward(2, 3, 1e4, TO, TO, weights) - costs[0]
    np.testing.assert_allclose(change, 2.0 * np.linalg.norm(AT - TO), rtol=1e-5)


def test_the_slope_of_the_reward_by_the_times_is_a_unit_vector():
    slope = jax.grad(lambda at: published_reward(2, 3, 1e4, at, TO, RewardWeights(time=2.0)))
    expected = -2.0 * (AT - TO) / np.linalg.norm(AT - TO)
    np.testing.assert_allclose(slope(AT), expected, rtol=1e-5)
    np.testing.assert_array_equal(slope(TO), 0.0)


def test_rewards_of_a_batch_equal_a_loop():
    rng = np.random.default_rng(0)
    caught, cost = rng.integers(0, 4, NUM), np.exp(rng.uniform(7.0, 14.0, NUM))
    times = rng.uniform(0.3, 6.0, (2, NUM, 3)).astype(np.float32)
    reward = lambda caught, cost, at, to: published_reward(caught, 3, cost, at, to)  # noqa: E731
    batch = jax.jit(jax.vmap(reward))(caught, cost, *times)
    loop = [reward(*one) for one in zip(caught, cost, *times, strict=True)]
    np.testing.assert_allclose(batch, loop, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e3])
def test_every_action_gives_rising_times_between_their_bounds(scale):
    rng = np.random.default_rng(1)
    actions = scale * rng.normal(size=(256, 6)).astype(np.float32)
    latest = rng.uniform(0.6, 4.0, (256, 6)).astype(np.float32)
    present = rng.random((256, 6)) < 0.8
    choices = jax.jit(jax.vmap(times_of, (0, None, 0, 0)))(actions, 0.3, latest, present)
    order, times = np.asarray(choices.order), np.asarray(choices.times)
    np.testing.assert_array_equal(np.sort(order, axis=1), np.tile(np.arange(6), (256, 1)))
    assert (np.diff(times, axis=1) >= INSTANT - 1e-5).all() and times.min() >= 0.3 - 1e-5
    assert (times <= np.take_along_axis(latest, order, axis=1) + 1e-5).all()
    ordered = np.take_along_axis(present, order, axis=1)
    assert (ordered[:, :-1] >= ordered[:, 1:]).all()
    if scale == 0.0:
        assert (
            order[present.all(axis=1)][:, 0] == latest[present.all(axis=1)].argmin(axis=1)
        ).all()


def test_times_are_linear_in_the_action():
    choice = times_of(jnp.array([1.0, -1.0, 0.0]), 0.5, jnp.full(3, 4.5))
    np.testing.assert_array_equal(choice.order, [1, 2, 0])
    np.testing.assert_allclose(choice.times, [0.5, 2.5, 4.5], rtol=1e-6)


def test_the_observation_holds_the_states_and_is_zero_for_absent_targets():
    cases = cases_of()
    seen = np.asarray(jax.jit(jax.vmap(observe_published))(cases))
    assert seen.shape == (NUM, 28) and len({each.tobytes() for each in seen}) == NUM
    head = cases.head_state
    np.testing.assert_allclose(seen[:, :3], head[:, 0] / 4.0, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(seen[:, 3:7], axis=1), 1.0, rtol=1e-6)
    w, x, y, z = seen[:, 3:7].T
    up = np.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x**2 + y**2)], axis=1)
    thrust = head[:, 2] + cases.gravity[:, None] * [0.0, 0.0, 1.0]
    np.testing.assert_allclose(up * np.linalg.norm(thrust, axis=1)[:, None], thrust, atol=1e-4)
    assert w.min() > 0.0 and np.ptp(w) > 0.01
    np.testing.assert_allclose(seen[:, 7:10], head[:, 1] / 4.0, rtol=1e-6)
    balls = np.concatenate([cases.targets.ball.pos, cases.targets.ball.vel], axis=1) / 4.0
    np.testing.assert_allclose(seen[:, 10:], balls.reshape(NUM, -1), rtol=1e-6)
    alone = dataclasses.replace(cases, present=np.tile([True, False, True], (NUM, 1)))
    less = np.asarray(jax.vmap(observe_published)(alone))
    assert not less[:, [13, 14, 15, 22, 23, 24]].any()
    np.testing.assert_array_equal(less[:, 16:22], seen[:, 16:22])


@pytest.mark.parametrize(("size", "expected"), [(3, 6_211 + 3), (6, 7_564)])
def test_the_network_has_two_layers_of_64_units(size, expected):
    network, params = decision_of(size)
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == expected
    seen = jax.random.normal(jax.random.key(1), (5, network.features))
    mean, log_std = jnp.split(network.apply(params, seen), 2, axis=-1)
    np.testing.assert_allclose(jnp.exp(log_std), 0.5, rtol=1e-6)
    assert mean.shape == (5, size) and np.ptp(mean, axis=0).min() > 1e-3


def test_caught_targets_are_those_that_the_referee_accepts_by_the_rule_of_the_paper():
    rng = np.random.default_rng(2)
    cases = cases_of()
    durations = rng.uniform(1.5, 2.2, (NUM, 3)).astype(np.float32)
    order = rng.permuted(np.tile(np.arange(3, dtype=np.int32), (NUM, 1)), axis=1)
    tails = np.zeros((NUM, 3, 4, 3), np.float32)
    tails[:, :, 0] = rng.normal(size=(NUM, 3, 3)) * 0.07
    tails[:, :, 2, :2] = rng.uniform(-1.0, 1.0, (NUM, 3, 2))

    @jax.jit
    @jax.vmap
    def plan_of(case, order, durations, tails):
        times = jnp.cumsum(durations)
        balls = targets_at(jax.tree.map(lambda leaf: leaf[order], case.targets), times)
        below = case.net.height * body_z(tails[:, 2], case.gravity)
        tails = tails.at[:, 0].add(balls.pos - below)
        heads = jnp.concatenate([case.head_state[None], tails[:-1]])
        pieces = jax.vmap(minco)(heads, tails, jnp.zeros((3, 0, 3)), durations[:, None])
        path = PiecewisePolynomial(coeffs=pieces.coeffs[:, 0], durations=durations)
        own = {"order": order, "decided_times": times, "times": times}
        return CatchPlan(trajectory=path, gravity=case.gravity, **own, **pending(jnp.zeros(())))

    plans = plan_of(cases, order, durations, tails)
    widest = np.linspace(1.3, 1.8, NUM, dtype=np.float32)
    cases = dataclasses.replace(
        cases,
        net=dataclasses.replace(cases.net, max_angle=widest),
        limits=cases.limits.scale(1.5, cases.gravity),
    )
    rule: Any = {"tolerance": 0.05, "net_test": "ball", "continuity_tolerance": 0.1}
    verdict = pj.catch.judge(cases, plans, **rule)
    caught = np.asarray(jax.jit(jax.vmap(count_caught))(cases, plans))
    along = ("speed", "thrust low", "thrust high", "body rate", "ground")
    expected = np.where(np.isin(verdict.failed_limit, along), 0, verdict.num_caught)
    late = verdict.failed_limit == "catch time"  # these plans may also exceed a limit
    np.testing.assert_array_equal(caught[~late], expected[~late])
    assert (caught[late] <= verdict.num_caught[late]).all() and late.any()
    assert set(caught) == {0, 1, 2, 3} and (verdict.num_caught > expected).any()


def test_a_checkpoint_decides_as_its_network(tmp_path):
    network, params = decision_of(3)
    save_checkpoint(tmp_path / "mine.npz", params, network, {"t_min": 0.5})
    cases = cases_of()
    planner: Any = pj.catch.planner("catch", decide=f"policy:{tmp_path / 'mine.npz'}")
    found = policy(tmp_path / "mine.npz")
    assert planner.decision.t_min == 0.5 and found.network == network
    mean = network.apply(params, jax.vmap(observe_published)(cases))[:, :3]
    wanted = np.clip(0.5 + (cases.horizon - 0.5) * 0.5 * (1.0 + mean), 0.5, cases.horizon)
    choices = jax.vmap(planner.decision.propose)(cases)
    np.testing.assert_array_equal(choices.order[:, 0], np.argsort(wanted, axis=1, stable=True))
    sooner: Any = policy(tmp_path / "mine.npz", t_min=0.1)
    assert sooner.t_min == 0.1
    with pytest.raises(ValueError, match="t_min must be finite and > 0"):
        policy(tmp_path / "mine.npz", t_min=0.0)
    for wrong, words in ((cases_of("hexagon6"), "3 targets"), (cases_of("swarm8"), "3 targets")):
        with pytest.raises(ValueError, match=words):
            pj.plan(planner, wrong)
