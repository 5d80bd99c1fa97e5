"""Bounds on how far a robot can move under its limits, and cases that these bounds exclude."""

import dataclasses

import jax
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.protocol import Status, is_unsolved
from planner_jax.robot.quadrotor import ALLOWED, QuadrotorLimits, beyond_reach
from planner_jax.task.catch.context import is_too_far as is_catch_too_far
from planner_jax.task.catch.context import order_targets
from planner_jax.task.hit.context import is_too_far as is_hit_too_far
from planner_jax.task.hit.context import prepare_hit

HIT, CATCH = pj.hit.planner("exact"), pj.catch.planner("exact", decide="greedy")

hits_too_far = jax.jit(jax.vmap(lambda case: is_hit_too_far(prepare_hit(case))))
catches_too_far = jax.jit(jax.vmap(lambda case: is_catch_too_far(order_targets(case))))


def limits(**bounds):
    bounds = {"speed": 6.0, "body_rate": 5.0, "min_height": 0.2, **bounds}
    return QuadrotorLimits(**{name: np.float32(value) for name, value in bounds.items()})


def head(vel=(0.0, 0.0, 0.0)):
    state = np.zeros((4, 3), np.float32)
    state[0], state[1] = (1.0, 2.0, 3.0), vel
    return state


def beyond(position, time, state, **bounds):
    at = np.asarray([position], np.float32), np.asarray([time], np.float32)
    return float(beyond_reach(*at, state, limits(**bounds), np.float32(9.8))[0])


def test_a_quadrotor_at_rest_accelerates_and_then_flies_at_its_greatest_speed():
    speed, most = 6.0 * ALLOWED, 8.0 * ALLOWED
    far = (101.0, 2.0, 3.0)
    early = beyond(far, 0.5, head(), acceleration=8.0)
    assert early == pytest.approx(100.0 - 0.5 * most * 0.25, rel=1e-5)
    late = beyond(far, 3.0, head(), acceleration=8.0)
    assert late == pytest.approx(100.0 - (3.0 * speed - 0.5 * speed**2 / most), rel=1e-5)
    unlimited = beyond(far, 3.0, head())
    assert unlimited == pytest.approx(100.0 - 3.0 * speed, rel=1e-5)
    # An infinite thrust is no limit.
    infinite = beyond(far, 3.0, head(), min_thrust=0.0, max_thrust=np.inf)
    assert infinite == pytest.approx(unlimited, rel=1e-6)


def test_an_initial_velocity_moves_the_quadrotor_away_from_a_point_behind():
    flying = head((4.0, 0.0, 0.0))
    behind = beyond((-1.0, 2.0, 3.0), 0.5, flying, acceleration=8.0)
    assert behind == pytest.approx(4.0 - 0.5 * 8.0 * ALLOWED * 0.25, rel=1e-5)


def test_thrust_accelerates_less_upwards_than_sideways():
    bounds = {"min_thrust": 2.0, "max_thrust": 20.0}
    up = beyond((1.0, 2.0, 13.0), 0.4, head(), **bounds)
    aside = beyond((11.0, 2.0, 3.0), 0.4, head(), **bounds)
    assert up == pytest.approx(10.0 - 0.08 * (20.0 * ALLOWED - 9.8), rel=1e-5)
    assert aside < up


@pytest.fixture(scope="module")
def serves():
    drawn = jax.tree.map(np.array, pj.hit.draw(4, seed=1))
    drawn.ball.pos[1], drawn.ball.vel[1] = (-2.0, 0.0, 2.0), (-14.0, 0.0, 6.0)
    drawn.ball.pos[2], drawn.ball.vel[2] = (-6.5, 0.0, 0.6), (0.0, 0.0, -2.0)
    return drawn


def test_impossible_hits_are_given_up_after_the_first_round(serves):
    assert hits_too_far(serves).tolist() == [False, True, True, False]
    plans = pj.plan(HIT, serves)
    assert plans.status[1] == plans.status[2] == Status.TOO_FAR
    assert pj.are_solved(plans).tolist() == [True, False, False, True]
    assert not is_unsolved(plans.status).any()
    assert (plans.iterations[1:3] <= HIT.attempts[0].solver.max_steps).all()
    assert Status.TOO_FAR.message.startswith("no plan exists")


def test_a_ball_above_the_greatest_apex_until_it_lands_far_away_is_too_far(serves):
    high = serves.ball.pos.copy(), serves.ball.vel.copy()
    high[0][0], high[1][0] = (-3.0, 0.0, 6.5), (20.0, 0.0, 8.0)
    assert hits_too_far(dataclasses.replace(serves, ball=pj.BallState(*high)))[0]


def test_a_number_that_is_not_finite_rules_out_nothing(serves):
    pos = serves.ball.pos.copy()
    pos[1, 0] = np.nan
    broken = dataclasses.replace(serves, ball=pj.BallState(pos, serves.ball.vel))
    assert hits_too_far(broken).tolist() == [False, False, True, False]


def throw(*balls, horizon=1.2, **options):
    pos, vel = (np.asarray(part, np.float32)[None] for part in zip(*balls, strict=True))
    shape = pos.shape[:2]
    path = pj.BallPath(pj.BallState(pos, vel), 0.0 * pos, np.full(shape, 9.81, np.float32))
    case = pj.catch.case(path, np.full(shape, horizon, np.float32), **options)
    return jax.tree.map(np.asarray, case)


NEAR = ((2.0, 0.0, 2.0), (-2.0, 0.0, 3.0))
AWAY = ((3.0, 0.0, 2.0), (9.0, 0.0, 4.0))
LOW = ((1.0, 0.0, -1.5), (0.0, 0.0, 0.0))


def test_impossible_catches_are_given_up_after_the_first_round():
    cases = [throw(ball) for ball in (NEAR, AWAY, LOW)]
    cases = jax.tree.map(lambda *leaves: np.concatenate(leaves), *cases)
    assert catches_too_far(cases).tolist() == [False, True, True]
    plans = pj.plan(CATCH, cases)
    assert pj.are_solved(plans).tolist() == [True, False, False]
    assert (plans.status[1:] == Status.TOO_FAR).all()


def test_one_target_out_of_reach_is_enough_unless_it_is_optional_or_absent():
    assert catches_too_far(throw(NEAR, AWAY))[0]
    assert not catches_too_far(throw(NEAR, AWAY, optional=True))[0]
    assert not catches_too_far(throw(NEAR, AWAY, present=np.array([[True, False]])))[0]


@pytest.mark.parametrize("task", ["hits", "catches"])
@pytest.mark.slow
def test_no_solved_case_is_too_far_with_tight_limits(task):
    if task == "hits":
        cases, too_far, planner = pj.hit.draw(256, seed=5, limit_scale=0.35), hits_too_far, HIT
    else:
        cases = pj.catch.draw(256, "hard", 5, limit_scale=0.45)
        too_far, planner = catches_too_far, CATCH
    plans = pj.plan(planner, jax.tree.map(np.asarray, cases))
    ruled_out = np.asarray(too_far(cases))
    assert ruled_out.any() and pj.are_solved(plans).any()
    assert not (ruled_out & pj.are_solved(plans)).any()
    np.testing.assert_array_equal(plans.status == Status.TOO_FAR, ruled_out)
