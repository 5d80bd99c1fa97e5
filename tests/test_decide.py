"""Orders and times: hand-made cases whose answer is known, and what holds of all decisions."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath
from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.problem import Round
from planner_jax.protocol import Status, is_solved
from planner_jax.referee.catch import referee_catches
from planner_jax.task.catch import decide as decide_module
from planner_jax.task.catch.decide import (
    best_orders,
    closest_approach,
    decided,
    greedy,
    plan_catches,
)
from planner_jax.task.catch.exact import ExactCatch
from planner_jax.task.catch.scenario import catch_scenario
from planner_jax.task.catch.suites import make_suite

PLANNER = ExactCatch(rounds=(Round(1, LbfgsConfig(max_steps=20)),))
GREEDY = jax.jit(jax.vmap(greedy))
BEST = jax.jit(jax.vmap(best_orders, in_axes=(0, None)), static_argnums=1)
NUM = 8


def best(scenarios):
    return BEST(scenarios, 6)


def hanging(places, horizons):
    """Targets (B, N, 3) that hang still until their horizons (B, N)."""
    pos = jnp.asarray(places, jnp.float32)
    ball = BallState(pos, jnp.zeros_like(pos))
    targets = BallPath(ball, jnp.zeros_like(pos), jnp.zeros(pos.shape[:2]))
    return catch_scenario(targets, np.asarray(horizons, float), gravity=np.full(len(pos), 9.81))


NEAR, FAR = (-1.0, 0.0, 1.2), (2.0, 0.0, 1.2)  # targets of a quadrotor that waits at (0, 0, 1)


@pytest.fixture(scope="module")
def pairs():
    """A near target, and a far one that has time, is due soon, is too far, too low, or rises."""
    places = [(FAR, NEAR), (NEAR, FAR), ((100.0, 0.0, 1.2), NEAR), ((2.0, 0.0, 0.3), NEAR)]
    scenarios = hanging([*places, (FAR, NEAR)], [(4.0, 4.0), (4.0, 1.15)] + 3 * [(4.0, 4.0)])
    ball = scenarios.targets.ball
    rising = ball.replace(vel=ball.vel.at[4, 0].set(jnp.array([0.2, 0.0, 1.0])))
    return scenarios.replace(targets=scenarios.targets.replace(ball=rising))


@pytest.fixture(scope="module")
def triangles():
    return make_suite("triangle3", NUM, 4)


def orders(decision):
    return np.asarray(decision.order).tolist()


def rank(decision):
    """What an order is judged by: the last catch [s], with 10 s a metre out of reach."""
    return np.asarray(decision.times[..., -1] + 10.0 * decision.shortfall)


def test_greedy_catches_next_what_it_reaches_first(pairs):
    found = GREEDY(pairs)
    assert orders(found) == [[1, 0], [0, 1], [1, 0], [1, 0], [1, 0]]
    assert found.shortfall[0] == 0.0
    assert found.shortfall[1] > 0.1  # too late for the far one


def test_best_catches_first_what_is_due_first(pairs):
    found = best(pairs)
    assert orders(found)[0][0] == [1, 0]
    assert orders(found)[1][0] == [1, 0]
    assert found.shortfall[1, 0] == 0.0
    assert found.times[1, 0, 0] <= 1.15


def test_times_are_those_of_a_point_that_accelerates_evenly(pairs):
    """One metre from hover at 7 m/s^2 after 0.2 s, up to one of the 64 times that are tried."""
    found = GREEDY(pairs)
    arrival = 0.2 + np.sqrt(2.0 * 1.0 / 7.0)
    assert arrival <= found.times[0, 0] <= arrival + 4.0 / 64.0 + 1e-6


def test_shortfall_is_how_far_out_of_reach_a_target_stays(pairs):
    """In 4 s less the near catch the quadrotor comes nowhere near 100 m."""
    for shortfall in (GREEDY(pairs).shortfall[2], best(pairs).shortfall[2, 0]):
        assert 101.0 - 0.9 * 5.0 * 4.0 < shortfall < 101.0


def test_a_target_near_the_floor_or_from_below_counts_as_out_of_reach(pairs):
    low, rising = GREEDY(pairs).shortfall[3:]
    np.testing.assert_allclose(low, 10.0 * (0.25 + 0.1 + 0.2 - 0.3), rtol=1e-4)
    np.testing.assert_allclose(rising, 10.0 * (1.0 / np.hypot(1.0, 0.2) - 0.2), rtol=1e-4)


def test_all_orders_are_ranked_from_the_best(triangles):
    found = best(triangles)
    assert found.order.shape == (NUM, 6, 3)
    assert len({tuple(order) for order in orders(found)[0]}) == 6
    assert (np.diff(rank(found), axis=1) >= 0.0).all()


def test_best_is_never_later_than_greedy_in_its_own_estimate(pairs, triangles):
    for scenarios in (pairs, triangles):
        assert (rank(best(scenarios))[:, 0] <= rank(GREEDY(scenarios))).all()
    assert rank(best(pairs))[1, 0] < rank(GREEDY(pairs))[1]


def test_decisions_are_permutations_with_rising_times(triangles):
    for found in (GREEDY(triangles), best(triangles)):
        assert (np.sort(found.order, axis=-1) == np.arange(3)).all()
        assert (np.diff(found.times, axis=-1) > 0.0).all()
        assert (found.times > 0.0).all()


@pytest.mark.parametrize("decide", [GREEDY, best], ids=["greedy", "best"])
def test_absent_targets_come_last_and_change_nothing(triangles, decide):
    masks = np.array([[k & 1, k & 2, k & 4] for k in range(NUM)], bool)
    few = dataclasses.replace(triangles, present=masks)
    found = decide(few)
    order = np.asarray(found.order).reshape(NUM, -1, 3)
    here = masks[np.arange(NUM)[:, None, None], order]
    assert (here == (np.arange(3) < masks.sum(axis=1)[:, None, None])).all()
    np.testing.assert_array_equal(found.shortfall[0], 0.0)  # no target, nothing to miss
    whole, moved = decide(triangles), jnp.where(masks[..., None], 0.0, jnp.nan)
    pos = triangles.targets.ball.pos + moved  # absent targets may hold anything
    ball = triangles.targets.ball.replace(pos=pos)
    hidden = decide(dataclasses.replace(few, targets=triangles.targets.replace(ball=ball)))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(hidden), strict=True):
        np.testing.assert_array_equal(a[1:], b[1:])
    assert orders(whole)[-1] == orders(found)[-1]  # where all are present


def test_plans_follow_the_decision_and_best_catches_both_in_time(pairs):
    chosen, plans = plan_catches(PLANNER, pairs, decide="best")
    np.testing.assert_array_equal(plans.order, chosen.order)
    assert is_solved(plans.status[:2]).all()
    assert plans.order[1].tolist() == [1, 0]
    verdict = referee_catches(chosen, plans)
    assert verdict.success[:2].all(), [verdict.sentence(k) for k in range(2)]
    given, same = plan_catches(PLANNER, chosen, decide="given")
    assert given is chosen
    np.testing.assert_allclose(same.times[:2], plans.times[:2], rtol=1e-5)


@pytest.mark.parametrize("decide", ["best", "greedy"])
@pytest.mark.parametrize(("array", "kind"), [(np.asarray, np.ndarray), (jnp.asarray, jax.Array)])
def test_what_comes_back_is_of_the_kind_that_was_given(decide, array, kind, pairs):
    found = plan_catches(PLANNER, jax.tree.map(array, pairs), decide)
    assert all(isinstance(leaf, kind) for leaf in jax.tree.leaves(found))


def test_one_case_is_told_to_be_no_batch(pairs):
    with pytest.raises(ValueError, match="must be a batch"):
        plan_catches(PLANNER, jax.tree.map(lambda leaf: leaf[0], pairs), "greedy")


def test_the_last_round_is_for_cases_without_any_solved_order(pairs, monkeypatch):
    """Case 0 is solved in one order at once; the other one is not tried any longer for it."""
    planned, real = [], decide_module.plan

    def noted(planner, scenarios, **options):
        planned.append((len(planner.rounds), scenarios.order.shape[0]))
        return real(planner, scenarios, **options)

    monkeypatch.setattr(decide_module, "plan", noted)
    twice = dataclasses.replace(PLANNER, rounds=2 * PLANNER.rounds[:1])
    _, plans = plan_catches(twice, pairs, "best")
    unsolved = int((~is_solved(plans.status)).sum())
    assert 0 < unsolved < 5
    assert planned == [(1, 10), (1, 2 * unsolved)]


def test_greedy_plans_have_the_order_of_the_estimate(pairs):
    estimate = GREEDY(pairs)
    chosen, plans = plan_catches(PLANNER, pairs, decide="greedy")
    np.testing.assert_array_equal(chosen.order, estimate.order)
    np.testing.assert_array_equal(chosen.times, estimate.times)
    np.testing.assert_array_equal(plans.order, estimate.order)
    assert is_solved(plans.status[0])
    assert not is_solved(plans.status[1:3]).any()  # due before, or too far


def test_a_decision_sets_order_and_times_alone(triangles):
    estimate = GREEDY(triangles)
    after = decided(triangles, estimate)
    assert after.order is estimate.order
    assert after.times is estimate.times
    assert after.targets is triangles.targets


def test_an_unknown_decision_is_refused(pairs):
    with pytest.raises(ValueError, match="decide must be one of best, greedy, given, got 'worst'"):
        plan_catches(PLANNER, pairs, decide="worst")


@pytest.mark.parametrize("order", [[1, 1], [0, 2], [-1, 0]])
def test_a_given_order_that_is_no_permutation_is_refused(pairs, order):
    given = np.array([[0, 1], order, [1, 0], [0, 1], [1, 0]], np.int32)
    wrong = dataclasses.replace(pairs, order=given)
    line = rf"order must be a permutation of 0\.\.1, got \[{order[0]}, {order[1]}\] in scenario 1"
    with pytest.raises(ValueError, match=line):
        plan_catches(PLANNER, wrong, decide="given")


def test_closest_approach_is_what_the_greatest_speed_leaves(pairs):
    """100 m away, 4 s at 5 m/s, the net's size, and what a 64th of the time may hide."""
    gap = np.array(jax.jit(jax.vmap(closest_approach))(pairs))
    left = np.hypot(100.0, 0.2) - 5.0 * 4.0 - (0.2 + 0.125) - 5.0 * 4.0 / 64.0
    assert gap[2, 0] == pytest.approx(left, rel=1e-4)
    gap[2, 0] = 0.0
    assert not gap.any()


@pytest.mark.parametrize(("array", "kind"), [(np.asarray, np.ndarray), (jnp.asarray, jax.Array)])
def test_a_target_out_of_reach_is_named_and_its_neighbours_are_not(array, kind, pairs):
    _, plans = plan_catches(PLANNER, jax.tree.map(array, pairs), decide="greedy")
    assert isinstance(plans.status, kind)
    assert plans.status[2] == Status.OUT_OF_REACH
    assert Status(plans.status[2]).message.startswith("a target never comes within reach")
    assert (np.delete(plans.status, 2) != Status.OUT_OF_REACH).all()
