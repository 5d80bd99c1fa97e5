"""Gradients of teams: the robots' catches and recovery trajectories are minima of their own."""

import dataclasses

import jax
import numpy as np
import pytest
from flax import struct
from test_team import hanging

import planner_jax as pj
from planner_jax.benchmarks.gradient_errors import errors_of
from planner_jax.task.team.default_planner import ExactTeam
from planner_jax.task.team.meeting import least_distances

BY = ("shared.net.height", "shared.limits.speed", "head_states", "shared.targets.ball.pos")


def test_the_least_distance_of_crossing_paths_is_the_closed_form():
    speed = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    start = np.array([[-1.0, 0.0, 0.0], [0.0, -2.0, 0.0], [0.0, 0.0, 3.0]])
    coeffs = np.zeros((3, 1, 8, 3))
    coeffs[:, 0, 0], coeffs[:, 0, 1] = start, speed
    whole = pj.PiecewisePolynomial(coeffs, np.array([[2.0], [4.0], [1.0]]))
    apart = least_distances(jax.tree.map(np.float32, whole))
    # Robots 0 and 1 are at (t - 1, 0) and (0, t - 2) until 2 s, where robot 0 stops at (1, 0).
    np.testing.assert_allclose(apart, [0.5**0.5, 3.0, 3.0], rtol=1e-4)
    assert np.isinf(least_distances(jax.tree.map(lambda leaf: leaf[:1], whole))).all()


@struct.dataclass
class FartherApart(ExactTeam):
    """A planner whose robots must keep 2.9 m of distance in lane 1, after they have planned."""

    def settle(self, cases, plan_of=None):
        smooth, started = super().settle(cases, plan_of)
        least = started.least_distance * np.array([1.0, 2.9], np.float32)
        return smooth, dataclasses.replace(started, least_distance=least)


@pytest.mark.slow
def test_gradients_match_differences_of_new_plans_and_a_lost_distance_has_none():
    points, starts = [(1.3, 2.0, 2.0), (-1.3, 2.0, 2.2)], [(1.5, 0.0, 1.0), (-1.5, 0.0, 1.0)]
    one = hanging(points, starts)
    cases = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), one)
    planner = FartherApart(pj.team.planner().planner)
    last_catch = lambda plan: plan.robots.times[:, -1].max()  # noqa: E731
    found, errors = errors_of(planner, cases, last_catch, BY, seed=1)
    assert pj.are_solved(found.plans).tolist() == [True, False]
    assert errors[0] < 5e-3 and found.stationarity[0] < 1e-6
    assert np.isnan(found.by["shared.net.height"][1])
    assert found.plans.num_taken.tolist() == [2, 2]
    np.testing.assert_array_equal(np.asarray(found.plans.robots.recovery.durations)[0] > 0.0, True)
