"""Reasons why an arm does not block a ball: `pj.block.prospects`."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.robot.arm_motion import least_times
from planner_jax.robot.arm_scene import paper_scene

OPEN = paper_scene(has_pole=False)
BALL = (9.0, 0.5, 0.3), (-8.0, -0.4, 5.4)


def least(away, *, rates=0.0, regime="R2"):
    case = pj.block.case(*BALL, rates=rates, regime=regime)
    limits, away = case.limits, jnp.asarray(away, jnp.float32)
    settings = case.rates, limits.velocity, limits.acceleration, case.ends_at_rest
    return np.asarray(least_times(away, *settings)[0]), limits


@pytest.mark.parametrize("away", [0.05, -0.05, 1.5, -1.5])
def test_a_joint_at_rest_takes_the_least_time_of_its_limits(away):
    at_rest, limits = least(np.full(6, away))
    v, a, d = np.asarray(limits.velocity), np.asarray(limits.acceleration), abs(away)
    short = d < v**2 / a
    expected = np.where(short, 2.0 * np.sqrt(d / a), d / v + v / a)
    np.testing.assert_allclose(at_rest, expected, rtol=1e-5)
    free, limits = least(np.full(6, away), regime="R1")
    v, a = np.asarray(limits.velocity), np.asarray(limits.acceleration)
    expected = np.where(d < 0.5 * v**2 / a, np.sqrt(2.0 * d / a), d / v + 0.5 * v / a)
    np.testing.assert_allclose(free, expected, rtol=1e-5)


@pytest.mark.parametrize("rate", [0.5, -0.5, 2.0])
def test_a_moving_joint_first_brakes_if_it_would_turn_too_far(rate):
    away, a = 0.02, 30.0
    found, limits = least(np.full(6, away), rates=rate)
    stop = 0.5 * rate * abs(rate) / a
    back = abs(away - stop)  # angle that is left after braking to standstill
    v = np.asarray(limits.velocity)
    alone = np.where(back < v**2 / a, 2.0 * np.sqrt(back / a), back / v + v / a)
    turns_back = stop > away or rate < 0.0
    if turns_back:
        np.testing.assert_allclose(found, abs(rate) / a + alone, rtol=1e-4)
    else:  # faster than by a stop on the way
        assert (found < abs(rate) / a + alone).all()


@pytest.mark.slow
def test_a_ball_that_comes_too_early_could_be_blocked_if_it_came_later():
    ready = pj.block.case(*BALL, scene=OPEN)
    spare = -pj.block.prospects(ready).later
    assert spare > 0.0
    late = dataclasses.replace(ready, delay=ready.delay + spare + 0.1)
    found = pj.block.prospects(late)
    assert (
        found.later == pytest.approx(0.1, abs=2e-3) and "the arm is ready 0.1" in found.sentence()
    )
    assert not pj.are_solved(pj.plan(pj.block.planner(), late))
    again = dataclasses.replace(late, delay=late.delay - found.later - 0.12)
    assert pj.are_solved(pj.plan(pj.block.planner(), again))


def test_out_of_reach_in_collision_and_open_are_told_apart():
    aside = pj.block.case((9.0, 5.0, 0.3), BALL[1], scene=OPEN)
    assert pj.block.prospects(aside).poses == 0
    assert "cannot get to the ball's path" in pj.block.prospects(aside).sentence()
    high = dataclasses.replace(OPEN, floor=np.float32(5.0))
    buried = pj.block.prospects(pj.block.case(*BALL, scene=high))
    assert buried.poses > 0 and buried.clear == 0 and np.isinf(buried.later)
    assert "touches something in all" in buried.sentence()
    free = pj.block.prospects(pj.block.case(*BALL, scene=OPEN))
    assert free.clear > 0 and "if nothing is in the way" in free.sentence()
    with pytest.raises(ValueError, match="case must be one case"):
        pj.block.prospects(pj.block.draw(2))
