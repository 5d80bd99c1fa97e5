"""Starts of quadrotors, and cases far from (0, 0): origins, errors, and samples in the world."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import planner_jax as pj
from planner_jax.core.origin import move, to_world
from planner_jax.core.rules import is_sound
from planner_jax.export.crazyflie import poly4d
from planner_jax.export.px4 import trajectory_setpoints
from planner_jax.export.setpoints import setpoints_of
from tests.flown_plans import quadrotor
from tests.trees import assert_same

AWAY = np.array([5e5, 4e6, 0.0])
START, TARGET = np.array([0.3, -0.2, 1.0]), np.array([3.0, 0.1, 0.0])
BALL, VELOCITY = np.array([4.0, 0.5, 2.0]), np.array([-7.0, 0.0, 6.0])


def hit(by=0.0, **options):
    spheres = [pj.KeepOut(np.array([0.0, 2.0, 1.0]) + by, 0.3)]
    options = {"start": START + by, "extras": spheres, **options}
    return pj.hit.case(BALL + by, VELOCITY, TARGET + by, **options)


def catch(targets, by=0.0, **options):
    return pj.catch.case(targets, [1.2], start=START + by, **options)


def ball_path(by=0.0):
    ball = pj.BallState(BALL[None] + by, np.float32(VELOCITY)[None])
    return pj.BallPath(ball, np.zeros((1, 3), np.float32), np.full(1, 9.81, np.float32))


def ball_path_in_float32():
    path = ball_path(AWAY)
    return path.replace(ball=jax.tree.map(np.float32, path.ball))


def table(by=0.0):
    times = np.linspace(0.0, 1.3, 14)
    rows = BALL + times[:, None] * VELOCITY - [0.0, 0.0, 4.9] * times[:, None] ** 2
    return pj.table_path(times, rows[None] + by, nodes=32)


def flight(by=0.0):
    path = pj.predict_path(pj.BallState(BALL + by, VELOCITY), 1.3, 0.1, 9.81, num_nodes=32)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], path)


def test_a_hit_far_away_has_the_numbers_of_the_same_hit_at_the_origin():
    near, far = hit(), hit(AWAY)
    assert near.origin is None
    np.testing.assert_array_equal(far.origin, AWAY[:2])
    assert_same(far.replace(origin=None), near)


@pytest.mark.parametrize("path", [ball_path, table, flight])
def test_a_catch_far_away_has_the_numbers_of_the_same_catch_at_the_origin(path):
    near, far = catch(path()), catch(path(AWAY), AWAY)
    chex.assert_trees_all_close(far.replace(origin=None), near, rtol=1e-6, atol=2e-6)


def test_the_origin_of_a_batch_is_near_its_first_start():
    cases = hit(np.array([[1234.0, 0.0, 0.0], [1334.0, 60.0, 0.0]]), extras=())
    np.testing.assert_array_equal(cases.origin, [[1200.0, 0.0]] * 2)
    np.testing.assert_allclose(cases.ball.pos[1], BALL + [134.0, 60.0, 0.0])


@struct.dataclass
class Hanging:
    pos: jax.Array

    def at(self, time):
        return self.pos


def test_a_class_of_the_user_names_its_positions_or_is_relative_to_the_origin():
    with pytest.raises(pj.ArgumentError, match="targets must be of a class with `positions`"):
        catch(Hanging(BALL[None] + AWAY), AWAY)
    given = catch(Hanging(BALL[None]), AWAY, origin=AWAY[:2])
    np.testing.assert_array_equal(given.targets.pos, BALL[None])
    named = struct.dataclass(type("Named", (Hanging,), {"positions": {"pos": ()}}))
    np.testing.assert_allclose(catch(named(BALL[None] + AWAY), AWAY).targets.pos, BALL[None])


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: hit(AWAY, origin=(0.1, 0.0)), "origin must be exact in float32"),
        (lambda: hit(AWAY, origin=(0.1,)), "origin must have the shape"),
        (lambda: hit(AWAY, start=np.float32(START + AWAY)), "start must be in float64 NumPy"),
        (lambda: catch(ball_path_in_float32(), AWAY), "targets.ball.pos must be in float64 NumPy"),
        (lambda: hit(AWAY, origin=(0.0, 0.0)), "start must be within 10 km of the case's origin"),
    ],
)
def test_what_float32_cannot_hold_is_an_error_of_one_line(make, says):
    with pytest.raises(pj.ArgumentError, match=says) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_traced_cases_far_away_are_bad_input():
    case = jax.tree.map(np.asarray, hit())
    judge = jax.jit(lambda head: is_sound(dataclasses.replace(case, head_state=head)))
    assert judge(case.head_state)
    assert not judge(case.head_state + np.float32(5e5) * np.eye(4, 3, dtype=np.float32))


def test_samples_and_exports_of_a_plan_are_in_the_world():
    plan = quadrotor()
    far = plan.replace(origin=np.float32(AWAY[:2]))
    near = np.asarray(plan.sample(100.0).pos, float)
    np.testing.assert_array_equal(far.sample(100.0).pos, near + AWAY)
    np.testing.assert_array_equal(setpoints_of(far, 50.0).pos, setpoints_of(plan, 50.0).pos + AWAY)
    for write in (poly4d, lambda plan: trajectory_setpoints(plan, 50.0)):
        with pytest.raises(pj.ArgumentError, match="plan must be within 10 km of"):
            write(far)
    close = plan.replace(origin=np.float32([100.0, 0.0]))
    np.testing.assert_allclose(poly4d(close)[:, 1] - poly4d(plan)[:, 1], 100.0, atol=1e-5)
    found, own = (trajectory_setpoints(each, 50.0)["position"] for each in (close, plan))
    np.testing.assert_allclose(found, own + np.float32([0.0, 100.0, 0.0]), atol=1e-5)


def test_a_plan_is_judged_only_by_a_case_of_its_origin():
    plan = quadrotor().replace(origin=np.float32(AWAY[:2]))
    stroke = pj.hit.Stroke(*[np.zeros(())] * 6)
    with pytest.raises(pj.ArgumentError, match="plans must have the origin of the cases"):
        pj.hit.judge(hit(), pj.hit.HitPlan(**vars(plan), stroke=stroke))


def test_moving_batches_and_states_moves_their_positions_only(float64):
    states = np.random.default_rng(0).normal(size=(2, 4, 3))
    by = np.array([[100.0, 0.0], [0.0, -200.0]])
    moved = np.asarray(move("head_state", states, by, np.float64, (0,)))
    np.testing.assert_array_equal(moved[:, 1:], states[:, 1:])
    np.testing.assert_array_equal(moved[:, 0, :2], states[:, 0, :2] + by)
    rows = jnp.zeros((2, 5, 3))
    np.testing.assert_array_equal(to_world(rows, by)[1], [[0.0, -200.0, 0.0]] * 5)


@pytest.mark.parametrize("tilt", [0.0, 0.4, 2.0, np.pi])
def test_the_thrust_at_the_start_is_the_weight_along_the_attitude(tilt):
    half, axis = 0.5 * tilt, np.array([0.6, 0.8, 0.0])
    attitude = 3.0 * np.array([np.cos(half), *(np.sin(half) * axis)])
    found = hit(start_velocity=(1.0, 0.0, -2.0), start_attitude=attitude, gravity=3.7)
    up = np.cross(axis, [0.0, 0.0, 1.0]) * np.sin(tilt) + [0.0, 0.0, np.cos(tilt)]
    expected = [START, [1.0, 0.0, -2.0], 3.7 * (up - [0.0, 0.0, 1.0]), np.zeros(3)]
    np.testing.assert_allclose(found.head_state, expected, atol=1e-6)
    given = catch(ball_path(), start_velocity=(1.0, 0.0, 0.0), start_acceleration=(0.0, 2.0, 0.0))
    np.testing.assert_array_equal(given.head_state[1:], np.eye(3) * [[1.0], [2.0], [0.0]])


@pytest.mark.parametrize(
    ("start", "says"),
    [
        ({"start_attitude": (0.0, 0.0, 0.0, 0.0)}, "start_attitude must be a quaternion, got 0"),
        ({"start_attitude": (1.0, 0.0, 0.0)}, "start_attitude must have the shape"),
        ({"start_velocity": "fast"}, "start_velocity must be numbers"),
        ({"start_velocity": (np.nan, 0.0, 0.0)}, "start must be finite"),
        (
            {"start_attitude": (1.0, 0.0, 0.0, 0.0), "start_acceleration": (1.0, 0.0, 0.0)},
            "start_attitude must be left out beside start_acceleration",
        ),
    ],
)
def test_a_start_that_cannot_be_is_an_error_of_one_line(start, says):
    with pytest.raises(pj.ArgumentError, match=says) as caught:
        hit(**start)
    assert "\n" not in str(caught.value)
