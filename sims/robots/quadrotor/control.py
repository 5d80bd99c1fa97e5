"""Cascade SE(3) control by differential flatness and the Hopf fibration.

Paper 002, Section VI-C, and paper 000, Section VII-A: position and velocity feedback with the
plan's acceleration and jerk gives the wanted thrust and, at zero heading, attitude and body
rate (Watterson and Kumar, "Control of quadrotors using the Hopf fibration on SO(3)"); the
attitude's error corrects the body rate, and the body rate's error asks for a torque. What the
rotors take up only with a lag is asked of them with that lag undone.

World frame, z up; body rates and torques in the body frame; quaternions w x y z.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.robot.quadrotor import body_z, net_thrust, tangent_basis
from planner_jax.sims.model import Physics, World
from planner_jax.sims.vehicle import rotor_thrusts
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate


@dataclasses.dataclass(frozen=True)
class Gains:
    """All gains of the cascade; static under jit."""

    position: float = 20.0  # [1/s^2]
    velocity: float = 8.0  # [1/s]
    attitude: float = 16.0  # [1/s]
    heading: float = 4.0  # [1/s], of the attitude's error about body z
    rate: float = 25.0  # [1/s]
    share: float = 0.5  # of the plan's thrust, largest correction of it
    correction: float = 6.0  # [rad/s], largest body rate against an attitude's error


@struct.dataclass
class RobotState:
    """The quadrotor at one instant."""

    pos: Array  # (3,) [m]
    vel: Array  # (3,) [m/s]
    quat_wxyz: Array  # (4,) body to world
    rate: Array  # (3,) [rad/s], body frame


@struct.dataclass
class Reference:
    """What is to be tracked at one instant."""

    pos: Array  # (3,) [m]
    vel: Array  # (3,) [m/s]
    acc: Array  # (3,) [m/s^2]
    jerk: Array  # (3,) [m/s^3]
    thrust_lead: Array  # () [m/s^2], to be asked of the rotors beyond the thrust, for their lag
    angular_acc: Array  # (3,) [rad/s^2], body frame
    torque_lead: Array  # (3,) [rad/s^2], to be asked of them beyond that, for their lag


def robot_state(physics: Physics) -> RobotState:
    """The quadrotor's part of the simulated state."""
    qpos, qvel = physics.qpos, physics.qvel
    return RobotState(pos=qpos[:3], vel=qvel[:3], quat_wxyz=qpos[3:7], rate=qvel[3:6])


def rotation(quat_wxyz: Array) -> Array:
    """Rotation matrix (3, 3), body to world, of a unit quaternion (4,)."""
    w, x, y, z = quat_wxyz
    return jnp.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def flat_attitude(acc: Array, jerk: Array, gravity: float) -> tuple[Array, Array]:
    """Attitude and body rate of a motion, at zero heading of the Hopf fibration.

    Args:
        acc: (3,) [m/s^2].
        jerk: (3,) [m/s^3].
        gravity: [m/s^2].

    Returns:
        (3, 3) body to world, and (3,) [rad/s] in the body frame.
    """
    gravity_here = jnp.asarray(gravity, acc.dtype)
    z = body_z(acc, gravity_here)
    size = jnp.sqrt(jnp.maximum(jnp.sum(net_thrust(acc, gravity_here) ** 2), 1e-2))
    z_dot = (jerk - jnp.sum(jerk * z) * z) / size
    x, y = tangent_basis(z)
    twist = (z[1] * z_dot[0] - z[0] * z_dot[1]) / jnp.maximum(1.0 + z[2], 1e-2)
    rate = jnp.stack([-jnp.sum(y * z_dot), jnp.sum(x * z_dot), twist])
    return jnp.stack([x, y, z], axis=1), rate


def rotation_error(R: Array, R_wanted: Array) -> Array:
    """Rotation vector (3,) [rad], body frame, from one attitude to another up to half a turn.

    sin(angle) axis is exact; from it and the cosine the angle follows without an arc cosine.
    """
    E = jnp.matmul(R.T, R_wanted, precision=lax.Precision.HIGHEST)
    sine_axis = 0.5 * jnp.stack([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
    cosine = 0.5 * (jnp.trace(E) - 1.0)
    sine = jnp.sqrt(jnp.maximum(jnp.sum(sine_axis**2), 1e-12))
    return jnp.arctan2(sine, cosine) / sine * sine_axis


def reference_at(trajectory: PiecewisePolynomial, time: Array, world: World) -> Reference:
    """The plan at a time () [s] since its start, with what the rotors need to know ahead."""
    gravity = world.gravity
    order = lambda k, at: evaluate(trajectory, at, k)  # noqa: E731
    pos, vel, acc, jerk = (order(k, time) for k in range(4))
    lag, step = world.vehicle.rotor_lag, 2.0 * world.timestep
    # What is asked for now is taken up by the next step, and its force counts around that step's
    # beginning: MuJoCo's Euler is a leapfrog. In between it rises by itself, on average half way.
    ahead = time + 0.5 * world.timestep

    def flat(at: Array) -> tuple[Array, Array]:
        acc_then = order(2, at)
        size = jnp.sqrt(jnp.sum(net_thrust(acc_then, jnp.asarray(gravity, at.dtype)) ** 2))
        return size, flat_attitude(acc_then, order(3, at), gravity)[1]

    (less, before), (size, rate), (more, after) = (flat(ahead + k * step) for k in (-1, 0, 1))
    # A first-order lag undone: the value and `lag` times its rate of change.
    growth = (more - less) / (2.0 * step)
    angular_acc = (after - before) / (2.0 * step)
    angular_jerk = (after - 2.0 * rate + before) / step**2
    now = jnp.sqrt(jnp.sum(net_thrust(acc, jnp.asarray(gravity, acc.dtype)) ** 2))
    return Reference(
        pos=pos,
        vel=vel,
        acc=acc,
        jerk=jerk,
        thrust_lead=size + lag * growth - now,
        angular_acc=angular_acc,
        torque_lead=lag * angular_jerk,
    )


def control(state: RobotState, reference: Reference, gains: Gains, world: World) -> Array:
    """Rotor thrusts (4,) [N] that track a reference; pure, for one quadrotor."""
    vehicle, gravity = world.vehicle, world.gravity
    R = rotation(state.quat_wxyz)
    half = 0.5 * world.timestep  # the velocities of MuJoCo's Euler are that much older
    ahead, faster = reference.pos - state.pos, reference.vel - half * reference.acc - state.vel
    pull = net_thrust(reference.acc, jnp.asarray(gravity, ahead.dtype))
    back = gains.position * ahead + gains.velocity * faster
    # Unbounded, an error would turn a weak thrust any way, and the plan's with it.
    most = gains.share * jnp.sqrt(jnp.sum(pull**2))
    back *= jnp.minimum(most / jnp.sqrt(jnp.maximum(jnp.sum(back**2), 1e-6)), 1.0)
    acc = reference.acc + back
    jerk = reference.jerk + gains.position * faster
    R_wanted, rate_wanted = flat_attitude(acc, jerk, gravity)
    pull = net_thrust(acc, jnp.asarray(gravity, acc.dtype))
    thrust = vehicle.mass * (jnp.sum(pull * R[:, 2]) + reference.thrust_lead)
    stiffness = jnp.array([gains.attitude, gains.attitude, gains.heading], acc.dtype)
    highest = lax.Precision.HIGHEST
    turn = jnp.matmul(R.T, jnp.matmul(R_wanted, rate_wanted, precision=highest), precision=highest)
    # Unbounded, a large error would ask for a rate that saturated rotors cannot stop in time.
    back = jnp.clip(stiffness * rotation_error(R, R_wanted), -gains.correction, gains.correction)
    rate = turn - half * reference.angular_acc + back
    inertia = jnp.asarray(vehicle.inertia, acc.dtype)
    angular_acc = reference.angular_acc + reference.torque_lead
    angular_acc += gains.rate * (rate - state.rate)
    torque = inertia * angular_acc + jnp.cross(state.rate, inertia * state.rate)
    return rotor_thrusts(vehicle, jnp.maximum(thrust, 0.0), torque)
