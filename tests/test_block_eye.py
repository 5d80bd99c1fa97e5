"""Tests of simulated camera observations of throws, and of plans for the observed balls."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_block import SMALL

import planner_jax as pj
from planner_jax.ball.flight import drag_free_flight
from planner_jax.sims.perception.camera import in_view, looking_at
from planner_jax.sims.perception.contact_check import end_at_contact
from planner_jax.sims.perception.flight_fit import Sight, belief_at, error_across
from planner_jax.sims.perception.observation import cautious, eye, frame_times, mast_camera, see
from planner_jax.task.block.problem.flight import flight_of


@pytest.mark.parametrize("suite", ["pole", "short"])
def test_the_camera_on_the_mast_sees_all_throws_nearly_until_they_can_be_met(suite):
    cases = pj.block.draw(300, suite, seed=3)
    latest = jax.jit(jax.vmap(flight_of))(cases).earliest
    paths = jax.jit(jax.vmap(jax.vmap(drag_free_flight, (None, 0, None))))
    places = paths(cases.ball, np.linspace(0.0, 0.8, 20) * latest[:, None], cases.gravity).pos
    assert in_view(mast_camera(), places).all()


def test_one_fit_after_a_quarter_of_a_second_is_within_reach_of_the_shield():
    """Observe for 0.25 s at 60 Hz with 2 cm of noise; 90 % of the errors must be below 0.1 m."""
    cases = pj.block.draw(1000, "short", seed=11)
    seen = see(cases, eye(std=0.02), 0.25)
    assert (seen.fits.num == 16).all() and (seen.fits.status == Sight.SEEN).all()

    @jax.jit
    @jax.vmap
    def off(case, fit):
        flight = flight_of(case)
        middle = 0.5 * (flight.earliest + flight.latest)
        truth = drag_free_flight(case.ball, middle, case.gravity)
        return error_across(belief_at(fit, middle, case.gravity), truth)

    assert np.mean(off(cases, seen.fits) < 0.1) >= 0.9


def test_planners_get_the_fitted_ball_and_the_delay():
    cases = pj.block.draw(4, seed=5)
    seen = see(cases, eye(std=1e-4, rate=120.0), 0.25, overhead=0.05, seed=2)
    np.testing.assert_allclose(seen.cases.delay, 0.3, rtol=1e-6)
    np.testing.assert_allclose(seen.cases.ball.pos, cases.ball.pos, atol=1e-3)
    np.testing.assert_allclose(seen.cases.ball.vel, cases.ball.vel, atol=5e-3)
    assert not np.array_equal(seen.cases.ball.pos, cases.ball.pos)
    again = see(cases, eye(std=1e-4, rate=120.0), 0.25, overhead=0.05, seed=2)
    np.testing.assert_array_equal(again.cases.ball.pos, seen.cases.ball.pos)


def test_an_unseen_ball_is_a_status_of_fit_and_plan():
    cases = pj.block.draw(6, seed=5, regime="R1", wide=True)
    away = looking_at((0.0, 0.0, 1.0), (-5.0, 0.0, 1.0), size=(64, 64), field_of_view=1.0)
    seen = see(cases, eye(camera=away), 0.25)
    assert (seen.fits.status == Sight.NEVER_SEEN).all() and np.isnan(seen.cases.ball.pos).all()
    plans = pj.plan(SMALL, cautious(seen.cases))
    assert (plans.status == pj.Status.BAD_INPUT).all()
    assert not np.isin(plans.status, [0, 1]).any()
    truth = dataclasses.replace(cases, delay=seen.cases.delay)
    assert not pj.block.judge(truth, end_at_contact(truth, plans)).success.any()


@pytest.mark.parametrize("regime", ["R1", "R2"])
def test_the_referee_agrees_on_plans_for_the_true_ball(regime):
    cases = jax.tree.map(np.asarray, pj.block.draw(6, seed=8, regime=regime, wide=True))
    plans = pj.plan(SMALL, cases)
    solved = pj.are_solved(plans)
    met = end_at_contact(cases, plans)
    assert solved.sum() >= 3
    np.testing.assert_allclose(met.contact_time[solved], plans.contact_time[solved], atol=2e-4)
    if regime == "R1":
        np.testing.assert_array_equal(pj.block.judge(cases, met).success[solved], True)


def test_a_late_ball_meets_the_braking_arm():
    """Delay a ball by 10 ms, which must delay the contact by about 10 ms."""
    cases = jax.tree.map(np.asarray, pj.block.draw(6, seed=8, regime="R1", wide=True))
    near_middle = cautious(cases, offset=0.01)
    plans = pj.plan(SMALL, jax.tree.map(np.asarray, near_middle))
    solved = pj.are_solved(plans)
    assert solved.sum() >= 3
    back = jax.vmap(drag_free_flight)(cases.ball, np.full(6, -0.01, np.float32), cases.gravity)
    late = dataclasses.replace(cases, ball=back)
    met = end_at_contact(late, plans)
    moved = met.contact_time - plans.contact_time
    np.testing.assert_allclose(moved[solved], 0.01, atol=5e-3)
    verdict = pj.block.judge(late, met)
    assert verdict.success[solved].any()
    np.testing.assert_allclose(verdict.height[solved], 0.0, atol=1e-3)


def test_cautious_cases_enlarge_the_box_for_balls_that_miss_it():
    cases = pj.block.draw(4, seed=1, wide=True)
    ball = dataclasses.replace(cases.ball, vel=cases.ball.vel.at[1, 2].add(9.0))
    cases = dataclasses.replace(cases, ball=ball)
    given = cautious(cases, offset=0.03, grow=0.2)
    np.testing.assert_allclose(given.offset, 0.03)
    larger = given.scene.inner.upper - cases.scene.inner.upper
    np.testing.assert_allclose(larger[:, 0], [0.0, 0.2, 0.0, 0.0], atol=1e-6)
    np.testing.assert_array_equal(given.scene.inner.lower[:, 2], cases.scene.inner.lower[:, 2])


def test_frames_include_the_first_and_the_moment_itself():
    assert len(frame_times(eye(rate=60.0), 0.25)) == 16
    assert len(frame_times(eye(rate=30.0), 0.08)) == 3
    assert frame_times(eye(rate=120.0), 0.0).tolist() == [0.0]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda cases: eye(rate=0.0), "rate must be > 0, got 0"),
        (lambda cases: eye(std=0.0), "std must be > 0, got 0"),
        (lambda cases: see(cases, eye(), -0.1), "seconds must be >= 0, got -0.1"),
        (lambda cases: see(cases, eye(), 0.1, overhead=-1.0), "overhead must be >= 0, got -1"),
    ],
)
def test_invalid_arguments_are_rejected(make, message):
    with pytest.raises(ValueError, match=message):
        make(jax.tree.map(jnp.asarray, pj.block.draw(2)))
