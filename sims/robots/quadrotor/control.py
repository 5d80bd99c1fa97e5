"""Cascaded SE(3) control by differential flatness and the Hopf fibration.

The cascade follows [Yu2023bat, Section VI-C] and [Yu2023catch, Section VII-A]. Feedback of position
and velocity, with the plan's acceleration and jerk as feedforward, gives the desired thrust. The
thrust, the jerk and the heading determine the desired attitude and body rate [Watterson2020]. The
attitude error corrects the body rate. The error of the body rate gives a torque. Feedforward
commands are taken from ahead in time, to compensate the rotors' lag.

World frame, z up; body rates and torques in the body frame; quaternions w x y z.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.robot.attitude import flat_attitude
from planner_jax.robot.quadrotor import net_thrust
from planner_jax.robot.quadrotor_model import QuadrotorModel
from planner_jax.sims.model import World
from planner_jax.sims.robot import rotation
from planner_jax.sims.robots.quadrotor.allocation import rotor_thrusts
from planner_jax.sims.robots.quadrotor.reference import Reference


@dataclasses.dataclass(frozen=True)
class Gains:
    """All gains of the quadrotor's cascaded controller; static under `jax.jit`.

    With a rotor lag of 20 ms the loops are not well separated: a velocity gain that damps the
    position loop alone excites the attitude. With these gains every mode of the cascade has a
    damping ratio of at least 0.5.
    """

    position: float = 30.0  # [1/s^2], acceleration per position error
    velocity: float = 6.0  # [1/s], acceleration per velocity error
    attitude: float = 14.0  # [1/s], body rate per attitude error
    heading: float = 4.0  # [1/s], body rate per attitude error about body z
    rate: float = 32.0  # [1/s], angular acceleration per body rate error
    share: float = 0.3  # greatest feedback acceleration, as a fraction of the plan's thrust
    correction: float = 10.0  # [rad/s], greatest body rate that corrects an attitude error
    # [rad/s^2], greatest feedforward of the plan's angular acceleration, and of the addition that
    # compensates the rotors' lag. The snap of a plan jumps when the plan is replaced. The planned
    # angular acceleration is then far greater than rotors can follow, above all at weak thrust.
    feedforward: tuple[float, float] = (100.0, 50.0)
    # Greatest increase of a rotor's thrust that serves to produce a torque, divided by the rotor's
    # greatest thrust. The increase is 1 N for the quadrotors of [Yu2023bat] and [Yu2023catch].
    spare: float = 1.0 / 11.8


@struct.dataclass
class RobotState:
    """The state of the quadrotor at one instant, true or estimated."""

    pos: Array  # (3,) [m]
    vel: Array  # (3,) [m/s]
    quat_wxyz: Array  # (4,) body to world
    rate: Array  # (3,) [rad/s], body frame


def rotation_error(R: Array, R_wanted: Array) -> Array:
    """Return the rotation vector (3,) [rad], body frame, from attitude `R` to `R_wanted`.

    The vector (sine of the angle) times (axis) follows from the matrices. The angle is the atan2 of
    the vector's length and the cosine, which is more accurate than an arc cosine.
    """
    E = jnp.matmul(R.T, R_wanted, precision=lax.Precision.HIGHEST)
    sine_axis = 0.5 * jnp.stack([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
    cosine = 0.5 * (jnp.trace(E) - 1.0)
    sine = jnp.sqrt(jnp.maximum(jnp.sum(sine_axis**2), 1e-12))
    return jnp.arctan2(sine, cosine) / sine * sine_axis


def control(
    state: RobotState, reference: Reference, model: QuadrotorModel, gains: Gains, world: World
) -> Array:
    """Return rotor thrusts (R,) [N] that track a planned state, for one quadrotor.

    Args:
        state: estimated state of the quadrotor.
        reference: the planned state, with additions that compensate rotor lag.
        model: parameters of the quadrotor.
        gains: gains of the cascade.
        world: gravity and time step.
    """
    gravity = jnp.asarray(world.gravity, state.pos.dtype)
    R = rotation(state.quat_wxyz)
    half = 0.5 * world.timestep  # [s], by which MuJoCo's velocities are older than its positions
    ahead, faster = reference.pos - state.pos, reference.vel - half * reference.acc - state.vel
    load = reference.acc if reference.load is None else reference.load
    load_jerk = reference.jerk if reference.load_jerk is None else reference.load_jerk
    pull = net_thrust(load, gravity)
    back = gains.position * ahead + gains.velocity * faster
    # The feedback is bounded: if the planned thrust is small, a large feedback could turn the
    # commanded thrust in any direction.
    most = gains.share * jnp.sqrt(jnp.sum(pull**2))
    back *= jnp.minimum(most / jnp.sqrt(jnp.maximum(jnp.sum(back**2), 1e-6)), 1.0)
    acc = load + back
    jerk = load_jerk + gains.position * faster
    R_wanted, rate_wanted = flat_attitude(acc, jerk, gravity, reference.yaw)
    pull = net_thrust(acc, gravity)
    thrust = model.mass * (jnp.sum(pull * R[:, 2]) + reference.thrust_lead)
    stiffness = jnp.array([gains.attitude, gains.attitude, gains.heading], acc.dtype)
    highest = lax.Precision.HIGHEST
    turn = jnp.matmul(R.T, jnp.matmul(R_wanted, rate_wanted, precision=highest), precision=highest)
    # The correction is bounded, since saturated rotors could not stop a fast rotation in time.
    back = jnp.clip(stiffness * rotation_error(R, R_wanted), -gains.correction, gains.correction)
    rate = turn - half * reference.angular_acc + back
    inertia = jnp.asarray(model.inertia_matrix, acc.dtype)
    planned = jnp.stack([reference.angular_acc, reference.torque_lead])
    most = jnp.asarray(gains.feedforward, acc.dtype)
    size = jnp.sqrt(jnp.maximum(jnp.sum(planned**2, axis=1), 1e-6))
    angular_acc = jnp.sum(planned * jnp.minimum(most / size, 1.0)[:, None], axis=0)
    angular_acc += gains.rate * (rate - state.rate)
    spin = jnp.matmul(inertia, state.rate, precision=highest)
    torque = jnp.matmul(inertia, angular_acc, precision=highest) + jnp.cross(state.rate, spin)
    spare = gains.spare * model.rotors.max_thrust
    return rotor_thrusts(model.rotors, jnp.maximum(thrust, 0.0), torque, spare)
