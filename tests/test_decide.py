import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath
from planner_jax.core.protocol import Status, is_solved, is_unsolved
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.planning import batch
from planner_jax.planning.decided import DecidedPlanner, first_choice
from planner_jax.planning.plan import plan
from planner_jax.referee.catch import referee_catches
from planner_jax.task.catch import decide as decisions
from planner_jax.task.catch.decide import LENGTHS, Best, Given, Greedy, Random, beam
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.catch.estimate import follow, timetable
from planner_jax.task.catch.suites import draw
from tests.trees import assert_same

PLANNER = CatchProblem.planner(attempts=(Attempt(1, LbfgsConfig(max_steps=20)),))
NUM = 8
NEAR, FAR = (-1.0, 0.0, 1.2), (2.0, 0.0, 1.2)  # [m] Targets; the quadrotor starts at (0, 0, 1).


@jax.jit
@jax.vmap
def greedy(case):
    """Return the order and times that `Greedy` chooses for a case, leaves (N,)."""
    return pj.take(Greedy().propose(case), 0)


@jax.jit
@jax.vmap
def best(case):
    return Best(finalists=6).propose(case)


@jax.jit
@jax.vmap
def estimate(case, orders):
    return jax.vmap(lambda order: follow(case, timetable(case), order)[1])(orders)


def shortfall(cases, choices):
    shape = choices.order.shape
    orders = choices.order.reshape(shape[0], -1, shape[-1])
    return np.asarray(estimate(cases, orders)).reshape(shape[:-1])


def by(decision, planner=PLANNER):
    return DecidedPlanner(planner, decision)


def hanging(places, horizons):
    pos = jnp.asarray(places, jnp.float32)
    ball = BallState(pos, jnp.zeros_like(pos))
    targets = BallPath(ball, jnp.zeros_like(pos), jnp.zeros(pos.shape[:2]))
    return pj.catch.case(targets, np.asarray(horizons, float), gravity=np.full(len(pos), 9.81))


@pytest.fixture(scope="module")
def pairs():
    places = [(FAR, NEAR), (NEAR, FAR), ((100.0, 0.0, 1.2), NEAR), ((2.0, 0.0, 0.3), NEAR)]
    cases = hanging([*places, (FAR, NEAR)], [(4.0, 4.0), (4.0, 1.15)] + 3 * [(4.0, 4.0)])
    ball = cases.targets.ball
    rising = ball.replace(vel=ball.vel.at[4, 0].set(jnp.array([0.2, 0.0, 1.0])))
    return jax.tree.map(np.asarray, cases.replace(targets=cases.targets.replace(ball=rising)))


@pytest.fixture(scope="module")
def triangles():
    return draw(NUM, "triangle3", 4)


def rank(cases, choices):
    return np.asarray(choices.times[..., -1]) + 10.0 * shortfall(cases, choices)


def test_greedy_catches_next_what_it_reaches_first(pairs):
    found = greedy(pairs)
    assert found.order.tolist() == [[1, 0], [0, 1], [1, 0], [1, 0], [1, 0]]
    assert shortfall(pairs, found)[0] == 0.0
    assert shortfall(pairs, found)[1] > 0.1  # The far target is reached too late.


def test_best_catches_first_what_is_due_first(pairs):
    found = best(pairs)
    assert found.order[:2, 0].tolist() == [[1, 0], [1, 0]]
    assert shortfall(pairs, found)[1, 0] == 0.0
    assert found.times[1, 0, 0] <= 1.15


def test_times_are_those_of_a_point_that_accelerates_evenly(pairs):
    found = greedy(pairs)
    arrival = 0.2 + np.sqrt(2.0 * 1.0 / 7.0)
    assert arrival <= found.times[0, 0] <= arrival + 4.0 / 64.0 + 1e-6


def test_shortfall_is_how_far_out_of_reach_a_target_stays_also_near_the_floor_or_rising(pairs):
    far, low, rising = shortfall(pairs, greedy(pairs))[2:]
    for missing in (far, shortfall(pairs, best(pairs))[2, 0]):
        assert 101.0 - 0.9 * 5.0 * 4.0 < missing < 101.0
    np.testing.assert_allclose(low, 10.0 * (0.25 + 0.1 + 0.2 - 0.3), rtol=1e-4)
    np.testing.assert_allclose(rising, 10.0 * (1.0 / np.hypot(1.0, 0.2) - 0.2), rtol=1e-4)


def test_all_orders_are_ranked_from_the_best(triangles):
    found = best(triangles)
    assert found.order.shape == (NUM, 6, 3)
    assert len({tuple(order) for order in found.order.tolist()[0]}) == 6
    assert (np.diff(rank(triangles, found), axis=1) >= 0.0).all()


def test_best_is_never_later_than_greedy_in_its_own_estimate(pairs, triangles):
    for cases in (pairs, triangles):
        assert (rank(cases, best(cases))[:, 0] <= rank(cases, greedy(cases))).all()
    assert rank(pairs, best(pairs))[1, 0] < rank(pairs, greedy(pairs))[1]


def test_decisions_are_permutations_with_rising_times(triangles):
    for found in (greedy(triangles), best(triangles)):
        assert (np.sort(found.order, axis=-1) == np.arange(3)).all()
        assert (np.diff(found.times, axis=-1) > 0.0).all()
        assert (found.times > 0.0).all()


@pytest.mark.parametrize("decide", [greedy, best], ids=["greedy", "best"])
def test_absent_targets_come_last_and_change_nothing(triangles, decide):
    masks = np.array([[k & 1, k & 2, k & 4] for k in range(NUM)], bool)
    few = dataclasses.replace(triangles, present=masks)
    found = decide(few)
    order = np.asarray(found.order).reshape(NUM, -1, 3)
    here = masks[np.arange(NUM)[:, None, None], order]
    assert (here == (np.arange(3) < masks.sum(axis=1)[:, None, None])).all()
    missing = shortfall(few, found)
    np.testing.assert_array_equal(missing[0], 0.0)  # No target is present.
    whole = decide(triangles)
    pos = triangles.targets.ball.pos + jnp.where(masks[..., None], 0.0, jnp.nan)
    ball = triangles.targets.ball.replace(pos=pos)
    with_nan = dataclasses.replace(few, targets=triangles.targets.replace(ball=ball))
    assert_same(decide(with_nan), found, slice(1, None))
    np.testing.assert_array_equal(missing[1:], shortfall(with_nan, decide(with_nan))[1:])
    assert whole.order.tolist()[-1] == found.order.tolist()[-1]  # All targets are present.


@pytest.mark.slow
def test_plans_follow_the_decision_and_best_catches_both_in_time(pairs):
    plans = plan(by(Best()), pairs)
    proposed = best(pairs)
    for k in range(5):  # Each plan has order and times of one choice.
        place = proposed.order.tolist()[k].index(plans.order[k].tolist())
        np.testing.assert_array_equal(plans.decided_times[k], proposed.times[k, place])
    assert is_solved(plans.status[:2]).all()
    assert plans.order[1].tolist() == [1, 0]
    verdict = referee_catches(pairs, plans)
    assert verdict.success[:2].all(), [verdict.sentence(k) for k in range(2)]
    same = plan(by(Given()), pairs.with_choice(plans.choice))
    np.testing.assert_array_equal(same.order, plans.order)
    np.testing.assert_array_equal(same.decided_times, plans.decided_times)
    np.testing.assert_allclose(same.times[:2], plans.times[:2], rtol=1e-5)


@pytest.mark.parametrize(
    "decide", [Best(), pytest.param(Greedy(), marks=pytest.mark.slow)], ids=["best", "greedy"]
)
def test_one_case_alone_is_decided_on_and_planned_as_in_its_batch(decide, pairs):
    alone, together = plan(by(decide), pj.take(pairs, 1)), plan(by(decide), pairs)
    assert alone.order.tolist() == together.order[1].tolist()
    assert alone.status == together.status[1]
    np.testing.assert_allclose(alone.decided_times, together.decided_times[1], rtol=1e-6)
    np.testing.assert_allclose(alone.times, together.times[1], rtol=2e-3)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class LongFirst(CatchProblem):
    """A problem whose first search tries every order of catches, and later searches only few."""

    def starts_long(self, cases, attempts):
        return True


@pytest.mark.parametrize(
    "kind, num, calls",
    [
        (CatchProblem, 2, [(1, 10), (1, 2)]),
        pytest.param(LongFirst, 3, [(1, 10), (1, 2), (1, 2)], marks=pytest.mark.slow),
    ],
)
def test_later_rounds_are_for_cases_without_any_solved_order(kind, num, calls, pairs, monkeypatch):
    horizon = np.array(pairs.horizon)
    horizon[1, 1] = 0.7
    pairs = dataclasses.replace(pairs, horizon=horizon)
    planned, plan_batch = [], batch.plan_batch

    def note_call(planner, attempts, cases, *where):
        planned.append((len(attempts), cases.order.shape[0]))
        return plan_batch(planner, attempts, cases, *where)

    monkeypatch.setattr(batch, "plan_batch", note_call)
    plans = plan(by(Best(), kind.planner(num * PLANNER.attempts[:1])), pairs)
    assert is_solved(np.delete(plans.status, [1, 2])).all()
    assert is_unsolved(plans.status[1]) and plans.status[2] == Status.TOO_FAR
    assert planned == calls


@pytest.mark.parametrize(("array", "kind"), [(np.asarray, np.ndarray), (jnp.asarray, jax.Array)])
def test_greedy_plans_have_the_estimated_order_and_targets_out_of_reach_are_named(
    array, kind, pairs
):
    decided, plans = greedy(pairs), plan(by(Greedy()), jax.tree.map(array, pairs))
    assert isinstance(plans.status, kind) and plans.status[2] == Status.TOO_FAR
    assert (np.delete(plans.status, 2) != Status.TOO_FAR).all()
    np.testing.assert_array_equal(plans.order, decided.order)
    np.testing.assert_array_equal(plans.decided_times, decided.times)
    assert is_solved(plans.status[0])
    assert not is_solved(plans.status[1:3]).any()  # The target is due too soon, or too far away.


def test_a_decision_sets_order_and_times_alone(triangles):
    choice = greedy(triangles)
    after = triangles.with_choice(choice)
    assert after.order is choice.order
    assert after.times is choice.times
    assert after.targets is triangles.targets
    first = first_choice(Greedy(), triangles)
    np.testing.assert_array_equal(first.order, choice.order)
    np.testing.assert_array_equal(first.times, choice.times)
    one = first_choice(Greedy(), pj.take(triangles, 3))
    assert one.order.tolist() == choice.order.tolist()[3]


def test_fewer_finalists_are_the_first_of_more_and_one_is_needed(triangles):
    few = jax.jit(jax.vmap(Best(finalists=2).propose))(triangles)
    assert_same(few, jax.tree.map(lambda leaf: leaf[:, :2], best(triangles)))
    with pytest.raises(ValueError, match="finalists must be >= 1, got 0"):
        Best(finalists=0)


def test_the_time_ratio_is_that_of_the_present_targets(pairs):
    present = np.ones((5, 2), bool)
    present[4, 1] = False
    order = np.array([[0, 1], [1, 0], [0, 1], [1, 0], [0, 1]])
    given = np.array([[1.0, 2.0]] * 5)
    plans = plan(by(Given()), pairs).replace(
        order=order, decided_times=given, times=given * [1.25, 0.8]
    )
    ratio = decisions.optimal_time_ratio(pairs.replace(present=present), plans)
    np.testing.assert_allclose(ratio, [(0.2 + 0.25) / 2.0] * 4 + [0.2], rtol=1e-6)


@pytest.mark.parametrize("order", [[1, 1], [0, 2], [-1, 0]])
def test_a_given_order_that_is_no_permutation_is_refused(pairs, order):
    given = np.array([[0, 1], order, [1, 0], [0, 1], [1, 0]], np.int32)
    wrong = dataclasses.replace(pairs, order=given)
    first = next(place for place in order if place not in (0, 1) or order.count(place) > 1)
    with pytest.raises(pj.CaseError, match=f"^order must be a permutation, got {first} in lane 1$"):
        plan(by(Given()), wrong)
    line = rf"order must be a permutation of 0\.\.1, got \[{order[0]}, {order[1]}\] in case 1"
    with pytest.raises(ValueError, match=line):
        plan(by(Given()), jax.tree.map(jnp.asarray, wrong))


def test_closest_approach_is_what_the_greatest_speed_leaves(pairs):
    closest_approach = jax.jit(decisions.closest_approach)
    gap = np.array(closest_approach(pairs))
    left = np.hypot(100.0, 0.2) - 5.0 * 4.0 - (0.2 + 0.125) - 5.0 * 4.0 / 64.0
    assert gap[2, 0] == pytest.approx(left, rel=1e-4)
    np.testing.assert_allclose(closest_approach(pj.take(pairs, 2)), gap[2], rtol=1e-6)
    gap[2, 0] = 0.0
    assert not gap.any()


@pytest.fixture(scope="module")
def swarm():
    return jax.tree.map(np.asarray, draw(NUM, "swarm8", 2))


@pytest.fixture(scope="module")
def caught(swarm):
    return plan(by(Greedy()), swarm)


@jax.jit
@jax.vmap
def beams(case):
    return beam(case, timetable(case), 64)


def test_of_three_targets_the_bounded_search_finds_what_all_orders_hold(triangles):
    first, second = (rank(triangles, find(triangles))[:, 0] for find in (beams, best))
    np.testing.assert_allclose(first, second, rtol=1e-5)


def test_greedy_leaves_optional_targets_that_it_can_no_longer_reach(pairs):
    optional = dataclasses.replace(pairs, optional=True)
    found = greedy(optional)
    assert found.taken.tolist() == [[True, True], [True, False]] + 3 * [[False, True]]
    np.testing.assert_array_equal(found.order[2:, 0], 1)
    assert greedy(pairs).taken.all()


def test_an_order_of_optional_targets_is_proposed_in_several_lengths(swarm):
    found = jax.jit(jax.vmap(Greedy().propose))(swarm)
    assert found.taken.shape == (NUM, LENGTHS, 8)
    number = np.asarray(found.taken.sum(axis=2))
    np.testing.assert_array_equal(number, np.maximum(number[:, :1] - np.arange(LENGTHS), 0))
    ranked = np.take_along_axis(np.asarray(found.taken), np.asarray(found.order), axis=2)
    assert (np.diff(ranked.astype(int), axis=2) <= 0).all(), "taken targets come first"


@pytest.mark.slow
def test_what_is_taken_of_a_swarm_is_caught_and_counted(swarm, caught):
    verdict = referee_catches(swarm, caught)
    solved = np.asarray(is_solved(caught.status))
    assert solved.mean() > 0.5
    assert verdict.success[solved].all()
    np.testing.assert_array_equal(verdict.num_caught[solved], caught.num_taken[solved])
    all_of_them = referee_catches(dataclasses.replace(swarm, optional=False), caught)
    assert not all_of_them.success.any() and set(all_of_them.failed_limit) == {"catch time"}
    taken = caught.choice.taken
    np.testing.assert_array_equal(np.asarray(taken).sum(axis=1), caught.num_taken)


@pytest.mark.slow
def test_a_claimed_catch_of_an_optional_target_has_to_hold(swarm, caught):
    moved = np.array(swarm.targets.ball.pos)
    moved[np.arange(NUM), caught.order[:, 0]] += 1.0
    ball = dataclasses.replace(swarm.targets.ball, pos=moved)
    targets = dataclasses.replace(swarm.targets, ball=ball)
    verdict = referee_catches(dataclasses.replace(swarm, targets=targets), caught)
    assert not verdict.success.any()
    assert (verdict.num_caught < caught.num_taken).all()


@pytest.mark.slow
def test_a_search_takes_more_of_a_swarm_than_greed(swarm, caught):
    found = beams(swarm)
    number = np.asarray(found.taken.sum(axis=2))
    assert (number == number[:, :1]).all()
    assert number[:, 0].mean() > np.asarray(greedy(swarm).taken.sum(axis=1)).mean()
    times = np.asarray(found.times)
    assert (np.diff(times, axis=2) > 0.0).all()
    fewer = dataclasses.replace(caught, times=np.maximum(caught.times, 0) * 0.0)
    assert (Best().rank(caught) < Best().rank(fewer)).all()


def test_random_orders_are_permutations_and_the_same_for_equal_cases(triangles):
    propose = [jax.jit(jax.vmap(Random(seed).propose)) for seed in (0, 1)]
    orders = [propose[k](triangles).order[:, 0] for k in (0, 0, 1)]
    np.testing.assert_array_equal(np.sort(orders[0], axis=1), np.tile(np.arange(3), (NUM, 1)))
    np.testing.assert_array_equal(orders[0], orders[1])
    assert (orders[0] != orders[2]).any() and len(np.unique(orders[0], axis=0)) > 1
