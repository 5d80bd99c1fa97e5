import dataclasses

import jax
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.task.reach.closed_form import ClosedReach, StartedReach
from planner_jax.task.reach.default_planner import ReachPlanner, Search

START, GOAL = np.zeros(6), np.array([0.2, 0.05, -0.02, 0.01, 0.0, 0.0])
PLANNER = ReachPlanner(searches=(Search(),), slack=0.0)
FREE = pj.reach.make_scene()


def started(case, duration, goal=0):
    known = np.int32(goal), np.asarray(duration, case.angles.dtype)
    return StartedReach(**vars(case), known=known)


def duration_of(case):
    problem = ClosedReach(PLANNER)
    context = problem.prepare(case)
    return problem.objective(problem.guesses(context, 1)[0], context).cost


def test_the_slowest_joint_gives_the_derivatives_in_closed_form(float64):
    case = pj.reach.case(GOAL, angles=START, scene=FREE, dtype=np.float64)
    turn, most = GOAL[0], float(case.limits.acceleration[0])
    expected = 2.0 * np.sqrt(turn / most)
    assert expected < 2.0 * float(case.limits.velocity[0]) / most  # the joint never turns steadily

    def duration(angles, acceleration):
        limits = dataclasses.replace(case.limits, acceleration=acceleration)
        return duration_of(started(case.replace(angles=angles, limits=limits), expected))

    both = jax.value_and_grad(duration, argnums=(0, 1))
    value, by = both(case.angles, case.limits.acceleration)
    unit = np.eye(6)[0]
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    np.testing.assert_allclose(by[0], -unit / np.sqrt(turn * most), rtol=1e-12)
    np.testing.assert_allclose(by[1], -0.5 * expected / most * unit, rtol=1e-12)


def test_a_motion_of_another_duration_has_no_gradient():
    case = pj.reach.case(GOAL, angles=START, scene=FREE)
    usual = pj.plan(PLANNER, case).cost
    assert np.isfinite(duration_of(started(case, usual)))
    assert np.isnan(duration_of(started(case, 1.01 * usual)))


@pytest.mark.slow
def test_gradients_match_differences_of_new_plans():
    goals = np.stack([GOAL + 0.02 * k for k in range(4)])[:, None]
    cases = pj.reach.case(goals=goals, angles=np.zeros((4, 6)), scene=FREE)
    planner = pj.reach.planner()
    found = pj.gradient(planner, cases, of="cost", by=("angles", "limits.acceleration"))
    assert pj.are_solved(found.plans).all() and not np.any(found.residual)
    away = np.linspace(0.5, 1.0, 6, dtype=np.float32)
    moved = [
        pj.plan(planner, cases.replace(angles=cases.angles + step * away)).cost
        for step in (1e-2, -1e-2)
    ]
    slope = found.by["angles"] @ away
    np.testing.assert_allclose(slope, (moved[0] - moved[1]) / 2e-2, rtol=5e-3)
