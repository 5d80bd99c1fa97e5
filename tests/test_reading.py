"""Parts of batches: `pj.take`, `pj.are_solved`, single verdicts, and draws of later cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import region_of

import planner_jax as pj
from planner_jax.core.protocol import is_unsolved
from planner_jax.core.tasks import all_tasks
from planner_jax.task.hit import court
from planner_jax.task.hit.court import landing
from planner_jax.task.hit.spec import REAL_SCENARIOS
from tests.trees import assert_same

TASKS = ("hit", "catch")
SUITES = [(name, suite) for name in TASKS for suite in all_tasks()[name].suites]
CHEAP = {
    "hit": lambda: pj.hit.planner("juggle", nodes=6),
    "catch": lambda: pj.catch.planner("mpp", decide="given", speeds=(0.0,), nodes=6),
}


@pytest.fixture(params=TASKS)
def task(request):
    return pj.task_named(request.param)


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_a_lane_is_an_entry_of_every_leaf(array):
    cases = jax.tree.map(array, pj.hit.draw(5))
    for lanes, shape in ((3, ()), (slice(1, 3), (2,)), (np.array([4, 0]), (2,))):
        some = pj.take(cases, lanes)
        assert type(some) is type(cases) and some.batch_shape == shape
        assert_same(some, jax.tree.map(lambda leaf, at=lanes: np.asarray(leaf)[at], cases))
    with pytest.raises(IndexError):
        pj.take(jax.tree.map(np.asarray, cases), 5)


def test_solved_is_read_from_the_status():
    status = np.array(list(pj.Status), np.int32)
    blank = np.zeros(status.shape)
    plans = pj.Plan(cost=blank, violation=blank, iterations=blank, status=status)
    good = pj.are_solved(plans)
    assert good.tolist() == [True, True] + 9 * [False]
    assert isinstance(good, np.ndarray) and good.dtype == bool
    resident = pj.are_solved(jax.tree.map(jnp.asarray, plans))
    assert isinstance(resident, np.ndarray) and resident.tolist() == good.tolist()
    assert pj.are_solved(pj.take(plans, 1)) and not pj.are_solved(pj.take(plans, 4))
    # `is_unsolved` is true for INFEASIBLE, MAX_STEPS and OUT_OF_REACH, after which `plan` retries.
    assert is_unsolved(status).tolist() == [False, False, True, True, False, True, *5 * [False]]


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_a_verdict_on_one_plan_is_that_of_its_lane(task, array):
    cases = jax.tree.map(array, task.draw(4))
    plans = pj.plan(CHEAP[task.name](), cases)
    together = task.judge(cases, plans)
    assert isinstance(together, pj.Verdict) and together.success.shape == (4,)
    for k in range(4):
        alone = task.judge(pj.take(cases, k), pj.take(plans, k))
        for one in (alone, pj.take(together, k)):
            assert type(one) is type(together) and np.shape(one.success) == ()
            assert one.sentence() == together.sentence(k)
            for name in vars(one):
                np.testing.assert_array_equal(getattr(one, name), getattr(together, name)[k])
    some = pj.take(together, together.success)
    assert some.success.all() and some.success.shape == (together.success.sum(),)


def test_a_verdict_names_the_failure_its_time_and_its_size(task):
    cases = task.draw(2)
    plans = pj.plan(CHEAP[task.name](), cases)
    coeffs = np.array(plans.trajectory.coeffs)
    coeffs[1, 0, 0, 0] += 0.5
    moved = plans.replace(trajectory=plans.trajectory.replace(coeffs=coeffs))
    verdict = task.judge(cases, moved)
    assert not verdict.success[1] and verdict.failed_limit[1] == "head state"
    assert verdict.failed_time[1] == 0.0
    assert verdict.failed_excess[1] == pytest.approx(0.5, rel=1e-3)
    assert verdict.sentence(1).startswith("head state: ") and "0.5" in verdict.sentence(1)
    assert set(verdict.SENTENCES) > {"head state", "not finite"}


@pytest.mark.parametrize(("task_name", "suite"), SUITES)
def test_draws_continue_and_depend_on_the_seed_and_have_the_requested_type(task_name, suite):
    draw = pj.task_named(task_name).draw
    whole = draw(8, suite, 3)
    for first, num in ((0, 3), (5, 3)):
        assert_same(draw(num, suite, 3, first=first), pj.take(whole, slice(first, first + num)))
    with jax.enable_x64(True):
        one, other = (draw(3, suite, seed, dtype=jnp.float64) for seed in (0, 1))
    pairs = list(zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))
    assert any((a != b).any() for a, b in pairs)
    assert {leaf.dtype.name for leaf, _ in pairs} <= {"float64", "int32", "bool"}


def test_without_a_name_the_first_suite_is_drawn(task):
    assert_same(task.draw(3), task.draw(3, next(iter(task.suites)), 0))


def test_a_real_scenario_has_its_two_of_the_court_in_equal_shares():
    cases = jax.tree.map(np.asarray, pj.hit.draw(200, "S.1"))
    assert REAL_SCENARIOS["S.1"] == ("FNN", "FFN")
    _, point = landing(cases.ball.pos, cases.ball.vel, cases.drag, cases.gravity)
    near, far = 1 + court.REGIONS.index("N"), 1 + court.REGIONS.index("F")
    served, landed, aimed = (
        region_of(place[:, 0], place[:, 1]) for place in (cases.ball.pos, point, cases.target)
    )
    assert set(served) == {far} and set(aimed) == {near}
    assert (landed == near).sum() == (landed == far).sum() == 100


def test_weaker_limits_are_drawn_by_their_scale(task):
    whole, half = task.draw(2), task.draw(2, limit_scale=0.5)
    np.testing.assert_allclose(half.limits.speed, 0.5 * np.asarray(whole.limits.speed))
    np.testing.assert_allclose(half.limits.body_rate, 0.5 * np.asarray(whole.limits.body_rate))
    assert_same(half.head_state, whole.head_state)
