"""The Kalman filter of a simulated quadrotor's own state, in the closed loop of flights."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from scipy.spatial.transform import Rotation
from test_sims_run import DropPilot, HoverPlan

import planner_jax as pj
from planner_jax.perception import ROBOT_FILTER, difference
from planner_jax.sims import state_filter as own
from planner_jax.sims.launch import begin_filters, flight_keys, ready
from planner_jax.sims.loop import fly_leg, track
from planner_jax.sims.loop_state import Loop
from planner_jax.sims.noise import NOISES, RobotSensing
from planner_jax.sims.robot import Physics
from planner_jax.sims.settings import CatchFly, HitFly, RallyFly
from planner_jax.sims.tasks.catch import CATCH_WORLD, fly_catches, throws
from planner_jax.sims.tasks.hit import HIT_WORLD, REAL_SCENARIOS, fly_hits, volleys

LOOP = Loop(CATCH_WORLD, NOISES["lab"], robot_filter=RobotSensing())
ROBOT, STEP, STEPS = CATCH_WORLD.robot, CATCH_WORLD.timestep, LOOP.steps_per_observation
# Sensors whose errors are negligible, and an exact first belief.
EXACT = RobotSensing(1e-12, 1e-12, 1e-4, 1e-4, 0.02, *[1e-7] * 3)


def tumble(periods):
    """Return the physics at each step of a rigid motion that MuJoCo's Euler method integrates."""
    t = STEP * np.arange(1, periods * STEPS + 1)
    acc = np.stack([20.0 * np.sin(7.0 * t), 10.0 * np.cos(9.0 * t), 5.0 - 0.0 * t], axis=1)
    rate = np.stack([6.0 * np.sin(5.0 * t), 4.0 * np.cos(8.0 * t) - 4.0, 2.0 * t], axis=1)
    vel, turn, quats = STEP * np.cumsum(acc, axis=0), Rotation.identity(), []
    for each in Rotation.from_rotvec(STEP * rate):
        turn = turn * each
        quats.append(turn.as_quat(scalar_first=True))
    pos = np.array([0.0, 0.0, 1.0]) + STEP * np.cumsum(vel, axis=0)
    still = np.array([[0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]]), np.zeros((1, 6))
    moving = np.concatenate([pos, quats], axis=1), np.concatenate([vel, rate], axis=1)
    qpos, qvel = (np.concatenate(pair) for pair in zip(still, moving, strict=True))
    numbers: Any = qpos.astype(np.float32), qvel.astype(np.float32), np.zeros((len(qpos), 4))
    return Physics(*numbers)


@functools.partial(jax.jit, static_argnames="loop")
def follow(loop, path, key):
    """Return the belief after the motion `path`, and its error and covariance as in `judge`."""
    start_key, key = jax.random.split(key)
    at = lambda leaf: leaf.reshape(-1, STEPS, leaf.shape[-1])  # noqa: E731
    before, after = (
        jax.tree.map(lambda x, s=s: at(x[s]), path) for s in (slice(-1), slice(1, None))
    )
    errors = jax.random.normal(key, (len(after.qpos), STEPS + 1, 2, 3))

    def period(belief, now):
        before, after, errors = now
        step = lambda belief, now: own.advance_belief(loop, belief, *now)  # noqa: E731
        belief, measured = jax.lax.scan(step, belief, (before, after, errors[:-1]))
        last = ROBOT.state(jax.tree.map(lambda x: x[-1], after))
        return own.receive_pose(loop, belief, measured, last, errors[-1]), None

    first = own.first_belief(loop, ROBOT.state(jax.tree.map(lambda x: x[0], path)), start_key)
    belief = jax.lax.scan(period, first, (before, after, errors))[0]
    last = ROBOT.state(jax.tree.map(lambda x: x[-1], path))
    return belief, judge(loop, belief, last)


def judge(loop, belief, truth):
    """Return the error (15,) of the estimate of the own state, and its covariance."""

    def advance(state, imu):
        return ROBOT_FILTER.predict(state, imu[:3], imu[3:], STEP, own.filter_model(loop)), None

    state = jax.lax.scan(advance, belief.past, belief.imu)[0]
    return difference(belief.now, own.body_state(truth, STEP, belief.biases)), state.covariance


def require_band(error, covariance):
    error, covariance = np.asarray(error, float), np.asarray(covariance, float)
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    low, high = scipy.stats.chi2.interval(0.95, error.size)
    assert low < squares.sum() < high


def test_the_estimate_of_a_fast_motion_has_the_errors_of_its_covariance():
    keys = jax.random.split(jax.random.key(0), 40)
    _, judged = jax.vmap(follow, (None, None, 0))(LOOP, tumble(40), keys)
    require_band(*judged)
    assert np.abs(judged[0][:, :3]).max() < 0.003  # poses alone are late by 7 cm


def test_without_errors_the_estimate_is_the_true_state_in_spite_of_late_poses():
    path = tumble(40)
    belief, _ = follow(dataclasses.replace(LOOP, robot_filter=EXACT), path, jax.random.key(0))
    estimate = own.estimate_state(belief, STEP)
    truth = ROBOT.state(jax.tree.map(lambda x: x[-1], path))
    for name in ("pos", "vel", "quat_wxyz", "rate"):
        found, true = getattr(estimate, name), getattr(truth, name)
        np.testing.assert_allclose(found, true, atol=3e-4, err_msg=name)


def test_the_filter_is_a_setting_of_catches_and_hits_and_stated_in_their_reports():
    for kind in (CatchFly, HitFly):
        assert kind().flight().loop(record=False).robot_filter is None
        flight = kind(robot_filter=True, noise="none", observer="published").flight()
        assert flight.parameters()["robot_filter"] == dataclasses.asdict(RobotSensing())
        assert "own state by a Kalman filter of IMU and captured poses" in flight.conditions
        assert "own state" not in kind().flight().conditions
    assert RallyFly().robot_sensing is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"latency": 0.015}, "latency must be a multiple of the observations' 0.01 s, got 0.015"),
        ({"latency": -0.01}, "latency must be >= 0, got -0.01"),
        ({"pos_std": 0.0}, "pos_std must be > 0, got 0"),
    ],
)
def test_invalid_sensors_are_refused(changes, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        Loop(CATCH_WORLD, robot_filter=RobotSensing(**changes))


def test_flights_without_a_belief_refuse_the_filter():
    physics = jax.tree.map(lambda x: x[0], tumble(1))
    with pytest.raises(ValueError, match="^robot_filter must be None in this task, got sensors$"):
        track(LOOP, physics, None, jnp.zeros((4, 3)), jnp.zeros(1))


def fly(num):
    """Return the last states of flights that move by up to 1 m along each axis in one second."""
    place = jnp.tile(jnp.array([0.0, 0.0, 2.0]), (num, 1))
    way = np.random.default_rng(0).uniform(-1.0, 1.0, (num, 1, 3))
    rest_to_rest = np.array([0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0])[:, None]
    path = jnp.asarray((rest_to_rest * way).astype(np.float32))[:, None].at[:, 0, 0].add(place)
    codes = np.zeros(num, int)
    plan = HoverPlan(pj.PiecewisePolynomial(path, jnp.ones((num, 1))), codes, codes)
    flights = begin_filters(LOOP, ready(LOOP, place, flight_keys(0, np.arange(num))))
    flights = dataclasses.replace(flights, plan=plan, began=flights.time)
    pilot: Any = DropPilot()
    return fly_leg(LOOP, pilot, flights, None, jnp.zeros((num, 1)), num_periods=60)[0]


@pytest.mark.slow
def test_in_a_hundred_flights_the_own_state_has_the_errors_of_its_covariance():
    flights = fly(100)
    truth = jax.vmap(ROBOT.state)(flights.physics)
    require_band(*jax.jit(jax.vmap(functools.partial(judge, LOOP)))(flights.belief, truth))


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["none", "lab"])
def test_balls_are_caught_and_hit_with_the_filter(noise):
    settings = {"sensing": NOISES[noise], "robot_filter": RobotSensing()}
    world = dataclasses.replace(CATCH_WORLD, num_balls=2)
    assert fly_catches(Loop(world, replan=100.0, **settings), throws(4, 2)).caught.sum() >= 7
    served = volleys(4, REAL_SCENARIOS["S.1"])
    observer = "rls" if noise == "lab" else "energy"
    hits = fly_hits(Loop(HIT_WORLD, replan=50.0, observer=observer, **settings), served)
    assert hits.success.sum() >= 3
