"""Attitude, body rate and thrust of a quadrotor along a plan, at zero heading.

The heading is zero in the sense of the Hopf fibration, see `planner_jax.robot.quadrotor`.
"""

import jax.numpy as jnp
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
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate


def flat_attitude(acc: Array, jerk: Array, gravity: Array) -> tuple[Array, Array]:
    """Return rotation (3, 3) from body to world, and body rate (3,) [rad/s], at zero heading.

    Without thrust the body is upright. The rate is bounded there and near upside down, where the
    rate of the Hopf fibration has no limit.
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


def setpoint_at(
    leaves: tuple[PiecewisePolynomial, Array, Air | None], time: Array
) -> dict[str, Array]:
    """Return the `QuadrotorSetpoints`, except `time`, of (path, gravity, air) at a time () [s]."""
    path, gravity, air = leaves
    pos, vel, acc, jerk = (evaluate(path, time, order) for order in range(4))
    load, load_jerk = add_drag(air, vel, acc), add_drag_rate(air, acc, jerk)
    if air is None:
        thrust = jnp.sqrt(jnp.sum(net_thrust(acc, gravity) ** 2))
    else:
        thrust = thrust_in_air(air, vel, load, gravity)
    return {
        "pos": pos,
        "vel": vel,
        "acc": acc,
        "jerk": jerk,
        "quat_wxyz": tilt_quaternion(load, gravity),
        "body_rate": flat_attitude(load, load_jerk, gravity)[1],
        "thrust": thrust,
    }
