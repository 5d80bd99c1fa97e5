"""`pj.replan` for hits and catches, and its errors for planners that only plan from scratch."""

import dataclasses

import jax
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.planning.replan import Replanning
from planner_jax.trajectory.polynomial import states_at

NUM = 4
NONE = (Attempt(solver=LbfgsConfig(max_steps=0)),)
HIT = pj.hit.HitProblem.planner(pj.hit.HitProblem.attempts[:1])  # a program of test_exact
CATCH = pj.catch.planner(
    "exact", decide="greedy", attempts=(Attempt(1, LbfgsConfig(max_steps=20)),)
)


def unchanged(planner):
    """Return the planner's re-planner that makes no iterations."""
    return dataclasses.replace(planner.replanner(), attempts=NONE)


@pytest.fixture(scope="module")
def hits():
    cases = jax.tree.map(np.asarray, pj.hit.draw(NUM, seed=5))
    return cases, pj.plan(HIT, cases), {"ball": cases.ball}


@pytest.fixture(scope="module")
def catches():
    cases = jax.tree.map(np.asarray, pj.catch.draw(NUM, "throws", 3))
    return cases, pj.plan(CATCH, cases), {"targets": cases.targets}


def test_no_time_and_a_target_as_before_give_back_the_motion_of_a_catch(catches):
    cases, plans, news = catches
    again = pj.replan(unchanged(CATCH), cases, plans, 0.0, **news)
    assert again.status.shape == (NUM,)
    np.testing.assert_allclose(again.times, plans.times, atol=2e-6)
    np.testing.assert_allclose(again.cost, plans.cost, rtol=2e-3)
    for share in np.linspace(0.0, 1.0, 9):
        time = np.asarray(share * plans.times[:, 0])
        found, expected = (states_at(p.trajectory, time)[:, :3] for p in (again, plans))
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-3)


@pytest.mark.slow
def test_no_time_and_a_ball_as_before_give_back_the_motion_of_a_hit(hits):
    cases, plans, news = hits
    solved = pj.are_solved(plans)
    assert solved.any()
    start = pj.replan(unchanged(HIT), cases, plans, 0.0, **news)
    for name in ("time", "flight_time", "ball_pos", "normal", "ball_vel_after"):
        found, expected = (getattr(each.stroke, name) for each in (start, plans))
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    ends = states_at(start.trajectory, start.stroke.time)
    np.testing.assert_allclose(ends, states_at(plans.trajectory, plans.stroke.time), atol=2e-2)
    again = pj.replan(HIT, cases, plans, 0.0, **news)
    assert pj.are_solved(again)[solved].all()
    assert (again.cost[solved] <= 1.05 * plans.cost[solved]).all()
    np.testing.assert_allclose(again.stroke.time[solved], plans.stroke.time[solved], atol=0.05)


@pytest.mark.parametrize("task", ["hits", "catches"])
def test_later_plans_begin_where_the_robot_is_and_the_case_says_so(task, request):
    cases, plans, news = request.getfixturevalue(task)
    planner = (HIT if task == "hits" else CATCH).replanner()
    elapsed = np.linspace(0.0, 0.3, NUM).astype(np.float32)
    work = planner.begin(cases, plans, elapsed, **news)
    assert isinstance(work, Replanning) and work.batch_shape == (NUM,)
    np.testing.assert_allclose(work.case.head_state, states_at(plans.trajectory, elapsed))
    given = np.asarray(cases.head_state) + 0.01
    moved = planner.begin(cases, plans, elapsed, head_state=given, **news)
    np.testing.assert_array_equal(moved.case.head_state, given)


def test_plans_again_at_utm_coordinates_are_the_same(catches):
    cases, plans, news = catches
    away = np.array([5e5, 4e6, 0.0])
    ball = news["targets"].ball
    moved = news["targets"].replace(ball=ball.replace(pos=ball.pos.astype(float) + away))
    origin = np.tile(np.float32(away[:2]), (NUM, 1))
    far = [each.replace(origin=origin) for each in (cases, plans)]
    planner = unchanged(CATCH)
    found = pj.replan(planner, *far, 0.0, targets=moved)
    near = pj.replan(planner, cases, plans, 0.0, **news)
    np.testing.assert_array_equal(found.origin, origin)
    np.testing.assert_allclose(found.trajectory.coeffs, near.trajectory.coeffs, atol=1e-4)
    np.testing.assert_allclose(found.sample(9.0).pos, near.sample(9.0).pos + away, atol=1e-5)


@pytest.mark.parametrize("task", ["hits", "catches"])
def test_one_case_is_its_lane(task, request):
    cases, plans, news = request.getfixturevalue(task)
    planner = unchanged(HIT if task == "hits" else CATCH)
    elapsed = np.float32(0.1)
    together = pj.replan(planner, cases, plans, np.full(NUM, elapsed), **news)
    alone = pj.replan(planner, *pj.take((cases, plans), 1), elapsed, **pj.take(news, 1))
    assert alone.status.shape == () and alone.status == together.status[1]
    found, expected = (np.asarray(x.trajectory.durations) for x in (alone, pj.take(together, 1)))
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_a_new_drag_is_believed(hits):
    cases, plans, news = hits
    work = HIT.replanner().begin(cases, plans, 0.0, drag=2.0 * cases.drag, **news)
    np.testing.assert_array_equal(work.case.drag, 2.0 * cases.drag)


@pytest.mark.parametrize(("task", "name"), [("hit", "juggle"), ("hit", "bat"), ("catch", "mpp")])
def test_a_planner_that_cannot_plan_again_names_one_that_can(hits, catches, task, name):
    cases, plans, news = hits if task == "hit" else catches
    planner = pj.task_named(task).planner(name)
    says = f"^{planner.inner.title} cannot plan again: use hits' and catches' exact, "
    with pytest.raises(TypeError, match=says):
        pj.replan(planner, cases, plans, 0.0, **news)
