"""Attitude, body rate and thrust of a quadrotor along a plan.

The heading psi is the heading of the Hopf fibration, see `planner_jax.robot.quadrotor`: the
attitude is  R_tilt R_z(psi) , where R_tilt is the shortest rotation from upright to the thrust.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.core.arithmetic import components
from planner_jax.robot.quadrotor import (
    Air,
    add_drag,
    add_drag_rate,
    body_z,
    net_thrust,
    thrust_in_air,
)
from planner_jax.robot.rotor_thrusts import turn_back
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate


def flat_attitude(
    acc: Array, jerk: Array, gravity: Array, yaw: Array | None = None
) -> tuple[Array, Array]:
    """Return rotation (3, 3) from body to world, and body rate (3,) [rad/s].

    `yaw` (2,) [rad], [rad/s] has the heading and its derivative, both 0 by default. Without
    thrust the body is upright. The rate is bounded there and near upside down, where the rate of
    the Hopf fibration has no limit.
    """
    w, x, y, _ = components(tilt_quaternion(acc, gravity))
    axes = (
        jnp.stack([1.0 - 2.0 * y * y, 2.0 * x * y, -2.0 * w * y]),
        jnp.stack([2.0 * x * y, 1.0 - 2.0 * x * x, 2.0 * w * x]),
        jnp.stack([2.0 * w * y, -2.0 * w * x, w * w - x * x - y * y]),
    )
    z = axes[2]
    size = jnp.sqrt(jnp.maximum(jnp.sum(net_thrust(acc, gravity) ** 2), 1e-2))
    z_dot = (jerk - jnp.sum(jerk * z) * z) / size
    twist = (z[1] * z_dot[0] - z[0] * z_dot[1]) / jnp.maximum(1.0 + z[2], 1e-2)
    rate = jnp.stack([-jnp.sum(axes[1] * z_dot), jnp.sum(axes[0] * z_dot), twist])
    if yaw is not None:
        axes = (*turn_back(yaw[0], axes), z)
        rate = jnp.stack([*turn_back(yaw[0], components(rate)), twist + yaw[1]])
    return jnp.stack(axes, axis=1), rate


def tilt_quaternion(acc: Array, gravity: Array) -> Array:
    """Return the attitude at zero heading, a unit quaternion (4,) w x y z, for an acceleration.

    It is the shortest rotation from upright to the thrust direction z [Watterson2020]:
    (1 + z_z, -z_y, z_x, 0) / sqrt(2 (1 + z_z)). Below the horizontal the equal expression
    (|z_xy|, -(1 - z_z) z_y / |z_xy|, (1 - z_z) z_x / |z_xy|, 0) / sqrt(2 (1 - z_z)) has no small
    denominator. Exactly upside down every horizontal axis is shortest, and the y axis is selected.
    Without thrust the attitude is upright.
    """
    normal = body_z(acc, gravity)
    x, y, z = components(normal)
    z = jnp.where(jnp.any(normal != 0.0), z, 1.0)
    across = x * x + y * y
    has_side = across > 0.0
    side = jnp.sqrt(jnp.where(has_side, across, 1.0))
    half = jnp.sqrt(0.5 + 0.5 * jnp.abs(z))  # the greater one of sine and cosine of half the tilt
    less = jnp.where(has_side, 0.5 * side / half, 0.0)
    cosine, sine = jnp.where(z < 0.0, less, half), jnp.where(z < 0.0, half, less)
    turn_x, turn_y = jnp.where(has_side, -y / side, 0.0), jnp.where(has_side, x / side, 1.0)
    return jnp.stack([cosine, sine * turn_x, sine * turn_y, jnp.zeros_like(z)])


def turn_quaternion(quat: Array, heading: Array) -> Array:
    """Return the attitude (4,) at a heading () [rad] for an attitude at zero heading."""
    w, x, y, _ = components(quat)
    half = 0.5 * heading
    return jnp.stack([w * jnp.cos(half), *turn_back(half, (x, y)), w * jnp.sin(half)])


def yaw_at(heading: PiecewisePolynomial, time: Array) -> Array:
    """Return the heading (2,) [rad], [rad/s] and its derivative at a time () [s].

    After the end of the polynomial both stay constant.
    """
    time = jnp.minimum(time, jnp.sum(heading.durations))
    return jnp.concatenate([evaluate(heading, time, order) for order in range(2)])


@dataclasses.dataclass(frozen=True)
class QuadrotorSetpoints:
    """Samples of a quadrotor's plan at K equally spaced times; body x forward, z along the thrust.

    In a batch every array but `time` has a leading axis B. Entries after a plan's end are NaN.
    """

    time: np.ndarray  # (K,) [s] since the start of the plan
    pos: np.ndarray  # (K, 3) [m], centre of the propeller plane
    vel: np.ndarray  # (K, 3) [m/s]
    acc: np.ndarray  # (K, 3) [m/s^2]
    jerk: np.ndarray  # (K, 3) [m/s^3]
    # (K, 4), unit quaternions, body to world, at the heading of the Hopf fibration: a rotation by
    # the heading about z, then the shortest rotation from upright to the thrust
    quat_wxyz: np.ndarray
    body_rate: np.ndarray  # (K, 3) [rad/s], body frame
    thrust: np.ndarray  # (K,) [m/s^2], per unit mass


def setpoint_at(
    leaves: tuple[PiecewisePolynomial, Array, Air | None, PiecewisePolynomial | None], time: Array
) -> dict[str, Array]:
    """Return the `QuadrotorSetpoints`, except `time`, of a plan at a time () [s].

    `leaves` are the path, gravity, drag and wind, and the heading; None for a heading of 0.
    """
    path, gravity, air, heading = leaves
    pos, vel, acc, jerk = (evaluate(path, time, order) for order in range(4))
    load, load_jerk = add_drag(air, vel, acc), add_drag_rate(air, acc, jerk)
    if air is None:
        thrust = jnp.sqrt(jnp.sum(net_thrust(acc, gravity) ** 2))
    else:
        thrust = thrust_in_air(air, vel, load, gravity)
    quat, yaw = tilt_quaternion(load, gravity), None
    if heading is not None:
        yaw = yaw_at(heading, time)
        quat = turn_quaternion(quat, yaw[0])
    return {
        "pos": pos,
        "vel": vel,
        "acc": acc,
        "jerk": jerk,
        "quat_wxyz": quat,
        "body_rate": flat_attitude(load, load_jerk, gravity, yaw)[1],
        "thrust": thrust,
    }
