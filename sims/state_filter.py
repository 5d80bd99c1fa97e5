"""A quadrotor's estimate of its own state, by a Kalman filter of an IMU and captured poses.

The filter is `perception.ROBOT_FILTER`, as in [Yu2023catch, Section VII-A] and [Yu2023bat, Section
VI-C]. The IMU measures at every physics step. Poses are captured with the observations of the
balls, and arrive late. When a pose arrives, it corrects the belief about the time of its capture.
The measurements of the IMU since that time are then replayed. Between two poses, every measurement
predicts the mean.

MuJoCo's velocities belong to half a step before its positions. The filter's positions belong to the
time of the velocities, so that both agree to second order.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import DTypeLike

from planner_jax.ball.flight import gravity_vector
from planner_jax.perception.filters import ROBOT_FILTER
from planner_jax.perception.robot_filter import (
    BodyState,
    RobotFilterModel,
    RobotFilterState,
    conjugate,
    exponential,
    multiply,
    predict_mean,
    retract,
    rotate,
)
from planner_jax.sims.loop_state import Loop, RobotBelief
from planner_jax.sims.noise import RobotSensing
from planner_jax.sims.robot import Physics
from planner_jax.sims.robots.quadrotor.control import RobotState


def body_state(state: RobotState, timestep: float, biases: Array) -> BodyState:
    """Return the state that the filter estimates, at the time of MuJoCo's velocities."""
    pos = state.pos - 0.5 * timestep * state.vel
    return BodyState(pos, state.quat_wxyz, state.vel, biases[3:], biases[:3])


def estimate_state(belief: RobotBelief, timestep: float) -> RobotState:
    """Return the estimated state for the controller, in MuJoCo's convention."""
    now = belief.now
    pos = now.pos + 0.5 * timestep * now.vel
    return RobotState(pos, now.vel, now.quat_wxyz, belief.rate - now.rate_bias)


def first_belief(loop: Loop, state: RobotState, key: Array) -> RobotBelief:
    """Return a random belief about a quadrotor that has hovered for at least one latency.

    Args:
        loop: settings of the closed loop.
        state: true state.
        key: random key of the errors.
    """
    sensors, late = _sensors(loop), loop.late_poses
    num, dtype = late * loop.steps_per_observation, state.pos.dtype
    stds = {
        name: jnp.asarray(getattr(sensors, name), dtype)
        for name in ("pos_std", "attitude_std", "vel_std", "rate_bias_std", "force_bias_std")
    }
    keys = jax.random.split(key, 3)
    error = jnp.repeat(jnp.stack(list(stds.values())), 3) * jax.random.normal(keys[0], (15,), dtype)
    biases = jnp.concatenate([error[12:], error[9:12]])
    imu_errors = jax.random.normal(keys[1], (num, 2, 3), dtype)
    pose_errors = jax.random.normal(keys[2], (late, 2, 3), dtype)
    truth = body_state(state, loop.world.timestep, jnp.zeros_like(biases))
    mean = retract(truth, error.at[9:].set(0.0))
    belief = RobotBelief(
        past=ROBOT_FILTER.init(mean, **stds),
        imu=jax.vmap(lambda each: measure_imu(loop, state, state, biases, each))(imu_errors),
        poses=jax.vmap(lambda each: capture_pose(loop, state, each))(pose_errors),
        now=mean,
        rate=state.rate + biases[3:],
        biases=biases,
    )
    return _replay(loop, belief)


def measure_imu(
    loop: Loop, before: RobotState, after: RobotState, biases: Array, errors: Array
) -> Array:
    """Return the specific force [m/s^2] and body rate [rad/s] (6,) measured during one step.

    The force belongs to the attitude in the middle of the step, whose rate is the rate after it.
    `errors` (2, 3) are standard normal.
    """
    step, sensors = loop.world.timestep, _sensors(loop)
    middle = multiply(before.quat_wxyz, exponential(0.5 * step * after.rate))
    fall = gravity_vector(jnp.asarray(loop.world.gravity, after.vel.dtype))
    force = (after.vel - before.vel) / step - fall
    stds = jnp.sqrt(jnp.array([[sensors.force_density], [sensors.rate_density]]) / step)
    true = jnp.stack([rotate(conjugate(middle), force), after.rate])
    return (true + stds.astype(true.dtype) * errors).ravel() + biases


def capture_pose(loop: Loop, state: RobotState, errors: Array) -> Array:
    """Return a captured position [m] and quaternion (7,); `errors` (2, 3) are standard normal."""
    sensors = _sensors(loop)
    pos = body_state(state, loop.world.timestep, jnp.zeros(6)).pos + sensors.pos_std * errors[0]
    turned = multiply(state.quat_wxyz, exponential(sensors.attitude_std * errors[1]))
    return jnp.concatenate([pos, turned])


def advance_belief(
    loop: Loop, belief: RobotBelief, before: Physics, after: Physics, errors: Array
) -> tuple[RobotBelief, Array]:
    """Measure by the IMU during one physics step, and predict the mean.

    Returns:
        The belief after the step, and the measurement (6,) for `receive_pose`.
    """
    robot = loop.world.robot
    measured = measure_imu(loop, robot.state(before), robot.state(after), belief.biases, errors)
    now = _predict(loop, belief.now, measured)
    return dataclasses.replace(belief, now=now, rate=measured[3:]), measured


def receive_pose(
    loop: Loop, belief: RobotBelief, measured: Array, state: RobotState, errors: Array
) -> RobotBelief:
    """Capture a pose, and correct the belief by the pose that arrives at the same time.

    Args:
        loop: settings of the closed loop.
        belief: belief at the end of an observation period.
        measured: (S, 6), measurements of the IMU in the S steps of this period.
        state: true state; its pose is captured.
        errors: (2, 3) standard normal errors of the pose.
    """
    imu = jnp.concatenate([belief.imu, measured])
    poses = jnp.concatenate([belief.poses, capture_pose(loop, state, errors)[None]])
    model = filter_model(loop, imu.dtype)
    step = jnp.asarray(loop.world.timestep, imu.dtype)

    def advance(past: RobotFilterState, now: Array) -> tuple[RobotFilterState, None]:
        return ROBOT_FILTER.predict(past, now[:3], now[3:], step, model), None

    past = lax.scan(advance, belief.past, imu[: len(measured)])[0]
    past = ROBOT_FILTER.update(past, poses[0, :3], poses[0, 3:], model)
    rest = dataclasses.replace(belief, past=past, imu=imu[len(measured) :], poses=poses[1:])
    return _replay(loop, rest)


def _replay(loop: Loop, belief: RobotBelief) -> RobotBelief:
    """Return the belief with its mean predicted by all measurements since `belief.past`."""
    advance = lambda mean, now: (_predict(loop, mean, now), None)  # noqa: E731
    return dataclasses.replace(belief, now=lax.scan(advance, belief.past.mean, belief.imu)[0])


def filter_model(loop: Loop, dtype: DTypeLike = jnp.float32) -> RobotFilterModel:
    """Return the noise of IMU and poses, for the filter; biases are constant."""
    sensors = _sensors(loop)
    densities = sensors.rate_density, sensors.force_density, 0.0, 0.0
    numbers = loop.world.gravity, *densities, sensors.pos_std, sensors.attitude_std
    return RobotFilterModel(*(jnp.asarray(each, dtype) for each in numbers))


def _sensors(loop: Loop) -> RobotSensing:
    assert loop.robot_filter is not None
    return loop.robot_filter


def _predict(loop: Loop, mean: BodyState, measured: Array) -> BodyState:
    numbers = loop.world.timestep, loop.world.gravity
    step, gravity = (jnp.asarray(each, measured.dtype) for each in numbers)
    return predict_mean(mean, measured[:3], measured[3:], step, gravity)
