"""Tests of arms that plan again while they observe the ball."""

import dataclasses

import jax
import numpy as np
import pytest
from test_block import SMALL

import planner_jax as pj
from planner_jax.ball.flight import drag_free_flight
from planner_jax.core.protocol import Status, take
from planner_jax.sims.perception.camera import looking_at
from planner_jax.sims.perception.contact_check import end_at_contact
from planner_jax.sims.perception.flight_fit import Sight
from planner_jax.sims.perception.observation import cautious, eye
from planner_jax.sims.perception.receding import Aim, decide

AIMS = (Aim(0.02), Aim(0.09))
AGAIN = SMALL.replanner()


@pytest.fixture(scope="module")
def cases():
    return jax.tree.map(np.asarray, pj.block.draw(6, "short", seed=8, regime="R1", wide=True))


def judge(done):
    plans = end_at_contact(done.cases, done.plans)
    return pj.block.judge(done.cases, plans), pj.are_solved(plans)


def test_a_perfect_camera_gives_the_plans_of_no_camera(cases):
    done = decide(SMALL, cases, eye(std=1e-6), [0.25], aims=AIMS[:1])
    aimed = cautious(dataclasses.replace(cases, delay=done.cases.delay), offset=AIMS[0].offset)
    plans = pj.plan(SMALL, jax.tree.map(np.asarray, aimed))
    solved = pj.are_solved(plans)
    assert solved.sum() >= 2
    np.testing.assert_array_equal(pj.are_solved(done.plans), solved)
    both = take(done.plans, solved), take(plans, solved)
    np.testing.assert_allclose(*(each.contact_time for each in both), atol=1e-3)
    np.testing.assert_allclose(*(each.motion.coeffs[:, :, 0] for each in both), atol=1e-2)


@pytest.mark.slow
def test_with_exact_fits_deciding_again_changes_nothing(cases):
    once, again = (
        decide(SMALL, cases, eye(std=1e-6), moments, aims=AIMS[:1])
        for moments in ([0.2], [0.2, 0.3, 0.4])
    )
    had = once.motions == 1
    assert had.sum() >= 2
    np.testing.assert_array_equal(again.motions[had], 1)
    (first, _), (second, _) = judge(once), judge(again)
    assert (second.success >= first.success)[had].all() and first.success[had].any()


@pytest.mark.slow
def test_composed_pieces_are_one_motion_within_rate_limits(cases):
    done = decide(SMALL, cases, eye(std=0.02), [0.15, 0.25, 0.35, 0.45], aims=AIMS)
    verdict, solved = judge(done)
    assert (done.motions[solved] >= 1).all() and done.motions.max() >= 2
    of_joints = ("time", "start", "continuity", "velocity", "acceleration", "rest")
    assert not np.isin(verdict.failed_limit[solved], of_joints).any()
    assert verdict.success[done.motions >= 2].any()


def test_a_ball_that_is_never_seen_leaves_the_arm_at_home(cases):
    away = looking_at((0.0, 0.0, 1.0), (-5.0, 0.0, 1.0), size=(64, 64), field_of_view=1.0)
    done = decide(SMALL, cases, eye(camera=away), [0.2, 0.3])
    assert (done.fits.status == Sight.NEVER_SEEN).all() and not done.motions.any()
    assert (done.plans.status == Status.NON_FINITE).all() and np.isinf(done.start).all()
    np.testing.assert_array_equal(done.plans.motion.coeffs[:, 0, 0], cases.angles)
    assert not done.plans.motion.durations.any()


@pytest.mark.slow
def test_replanning_starts_from_the_motion_with_the_new_ball(cases):
    plans = pj.plan(SMALL, cases)
    solved = pj.are_solved(plans)
    off = np.array([0.0, 0.03, 0.03], np.float32)
    ball = dataclasses.replace(cases.ball, pos=cases.ball.pos + off)
    tasks = AGAIN.begin(cases, plans, 0.1, ball=ball)
    warm = pj.plan(AGAIN.warm, tasks)
    both = solved & pj.are_solved(warm)
    assert both.sum() >= 3
    assert pj.block.judge(take(tasks.case, both), take(warm, both)).success.all()
    again = pj.replan(SMALL, cases, plans, 0.1, ball=ball)
    np.testing.assert_array_equal(again.contact_time[both], warm.contact_time[both])


@pytest.mark.slow
def test_the_noise_of_a_throw_does_not_depend_on_its_batch(cases):
    seeds = np.arange(6, dtype=np.uint32)
    every = decide(SMALL, cases, eye(std=0.02), [0.2], seed=seeds, aims=AIMS[:1])
    some = decide(SMALL, take(cases, slice(2, 5)), eye(std=0.02), [0.2], seed=seeds[2:5], aims=AIMS)
    ours, theirs = every.fits.belief.mean[:, 2:5], some.fits.belief.mean
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"moments": []}, ValueError, "moments must rise from 0 or later"),
        ({"moments": [0.3, 0.2]}, ValueError, "moments must rise from 0 or later"),
        ({"overhead": -0.1}, ValueError, "overhead must be >= 0, got -0.1"),
        ({"planner": pj.block.planner("direct")}, TypeError, "DirectBlock decides once"),
    ],
)
def test_invalid_decisions_are_rejected(cases, change, error, message):
    given = {"planner": SMALL, "moments": [0.2, 0.3], **change}
    with pytest.raises(error, match=message):
        decide(given.pop("planner"), cases, eye(), **given)


def test_a_replanned_case_has_the_ball_of_the_original_case(cases):
    plans = pj.plan(SMALL, cases)
    task = AGAIN.begin(cases, plans, 0.2)
    here = jax.vmap(drag_free_flight)(task.case.ball, task.case.delay, task.case.gravity)
    there = jax.vmap(drag_free_flight)(cases.ball, cases.delay + 0.2, cases.gravity)
    np.testing.assert_allclose(here.pos, there.pos, atol=1e-5)
