import dataclasses

import chex
import jax
import numpy as np
import pytest

from planner_jax.core.protocol import Status, is_solved, take
from planner_jax.optimise.settings import Attempt, LbfgsConfig
from planner_jax.planning.plan import plan
from planner_jax.referee.catch import referee_catches
from planner_jax.task.catch.default_planner import CatchProblem
from planner_jax.task.catch.replan import REMAINDER
from planner_jax.task.catch.suites import draw
from planner_jax.trajectory.polynomial import states_at

SCRATCH = CatchProblem.planner(attempts=(Attempt(starts=1, solver=LbfgsConfig(max_steps=20)),))
USUAL = REMAINDER.planner_of(CatchProblem())
_SHORT = LbfgsConfig(max_steps=12, trial_steps=(1.0, 0.2, 0.04))
AGAIN = dataclasses.replace(USUAL, attempts=(Attempt(starts=1, solver=_SHORT),))
UNCHANGED = dataclasses.replace(USUAL, attempts=(Attempt(solver=LbfgsConfig(max_steps=0)),))


def plan_first(name, num):
    cases = draw(num, name)
    times = np.linspace(0.7, 0.9, cases.num_targets) * np.asarray(cases.horizon)
    cases = jax.tree.map(np.asarray, dataclasses.replace(cases, times=times))
    return cases, plan(SCRATCH, cases)


@pytest.fixture(scope="module")
def throws():
    cases, plans = plan_first("throws", 6)
    assert is_solved(plans.status).all()
    return cases, plans


@jax.jit
@jax.vmap
def states_of(targets, time):
    return jax.vmap(lambda path: path.at(time))(targets)


def ahead(cases, elapsed, noise=0.0):
    ball = states_of(cases.targets, np.asarray(elapsed, np.float32))
    random = np.random.default_rng(1)
    disturb = lambda x: np.asarray(x + noise * random.standard_normal(x.shape), np.float32)  # noqa: E731
    return dataclasses.replace(cases.targets, ball=jax.tree.map(disturb, ball))


def assert_same_flight(old, new, elapsed, until, atol):
    for share in np.linspace(0.0, 1.0, 23):
        found = states_at(new.trajectory, share * until)
        expected = states_at(old.trajectory, elapsed + share * until)
        np.testing.assert_allclose(found[:, :3], expected[:, :3], rtol=0, atol=atol)


def test_a_later_plan_begins_where_the_quadrotor_is_and_catches_the_target_that_moved(throws):
    cases, plans = throws
    elapsed = np.linspace(0.01, 0.5, 6)
    task = AGAIN.begin(cases, plans, elapsed, targets=ahead(cases, elapsed, 0.01))
    expected = states_at(plans.trajectory, elapsed)[:, :3]
    np.testing.assert_allclose(task.case.head_state[:, :3], expected, atol=1e-3)
    np.testing.assert_allclose(task.case.horizon, cases.horizon - elapsed[:, None])
    again = plan(AGAIN, task)
    verdict = referee_catches(task.case, again)
    assert verdict.success.all(), [verdict.sentence(k) for k in range(6)]
    assert np.abs(again.times - (plans.times - elapsed[:, None])).max() < 0.05


@pytest.mark.slow
def test_a_batch_is_its_cases(throws):
    cases, plans = throws
    elapsed = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 5.0], np.float32)
    task = AGAIN.begin(cases, plans, elapsed, targets=ahead(cases, elapsed, 0.005))
    together = plan(AGAIN, task)
    for k in range(6):
        targets = take(task.case.targets, k)
        own = AGAIN.begin(take(cases, k), take(plans, k), elapsed[k], targets=targets)
        chex.assert_trees_all_close(own, take(task, k), rtol=1e-4, atol=1e-4)
        alone = plan(AGAIN, own)
        np.testing.assert_allclose(alone.times, together.times[k], atol=2e-3)
        np.testing.assert_allclose(alone.cost, together.cost[k], rtol=0.02, atol=1e-6)


def test_with_too_little_time_left_the_previous_plan_is_kept(throws):
    cases, plans = throws
    left = np.array([0.049, 0.03, 0.01, 0.002, 0.06, 0.04], np.float32)
    elapsed = plans.times[:, 0] - left
    task = AGAIN.begin(cases, plans, elapsed, targets=ahead(cases, elapsed, 0.05))
    again = plan(AGAIN, task)
    kept = left < AGAIN.problem.shortest
    np.testing.assert_allclose(again.times[kept, 0], left[kept], atol=1e-6)
    np.testing.assert_array_equal(again.violation[kept], plans.violation[kept])
    assert is_solved(again.status[kept]).all()
    assert (again.trajectory.durations > 0.0).all()
    assert_same_flight(*(take(each, kept) for each in (plans, again, elapsed, left)), 1e-3)


@pytest.mark.slow
def test_what_is_left_of_a_plan_can_be_cut_anywhere(throws):
    cases, plans = throws
    keeping = UNCHANGED.with_settings((("shortest", 10.0),))
    elapsed = np.array([0.0, 0.02, 0.21, 0.43, 0.6, 0.7], np.float32)
    rest = plan(keeping, keeping.begin(cases, plans, elapsed, targets=ahead(cases, elapsed)))
    assert (rest.trajectory.durations > 0.0).all()
    assert_same_flight(plans, rest, elapsed, rest.times[:, 0], 1e-3)


def test_after_the_catch_the_plan_is_empty(throws):
    cases, plans = throws
    elapsed = plans.times[:, 0] + 0.01
    task = AGAIN.begin(cases, plans, elapsed, targets=ahead(cases, elapsed))
    assert not task.case.present.any()
    again = plan(AGAIN, task)
    assert not again.trajectory.durations.any() and np.isfinite(again.cost).all()
    assert (again.status != Status.NON_FINITE).all()
    caught = states_at(plans.trajectory, plans.times[:, 0])[:, 0]
    np.testing.assert_allclose(again.trajectory.coeffs[:, 0, 0], caught, atol=1e-4)


@pytest.mark.slow
def test_of_several_targets_those_not_caught_yet_are_planned_on():
    cases, _ = plan_first("triangle3", 4)
    order = np.array([2, 0, 1], np.int32)
    cases = dataclasses.replace(cases, order=np.tile(order, (4, 1)))
    longer = CatchProblem.planner(attempts=(Attempt(starts=1, solver=LbfgsConfig(max_steps=40)),))
    plans = plan(longer, cases)
    solved = is_solved(plans.status)
    assert solved.any()
    elapsed = 0.5 * (plans.times[:, 0] + plans.times[:, 1])
    task = AGAIN.begin(cases, plans, elapsed, targets=ahead(cases, elapsed, 0.005))
    np.testing.assert_array_equal(task.case.order, np.tile([0, 1, 2], (4, 1)))
    np.testing.assert_array_equal(task.case.present, np.tile([True, True, False], (4, 1)))
    again = plan(AGAIN, task)
    verdict = referee_catches(task.case, again)
    assert verdict.success[solved].all(), [verdict.sentence(k) for k in range(4)]
    assert (verdict.num_caught[solved] == 2).all()
