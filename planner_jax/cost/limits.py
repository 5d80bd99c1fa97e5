"""How far samples of a trajectory exceed the quadrotor's limits.

Each returns the squared quantity over its squared limit, less one: positive where the limit
is exceeded, without a square root to differentiate. `relative` turns that into the ratio of
the quantity to its limit, less one.
"""

import jax.numpy as jnp
from jax import Array

from planner_jax.robot.quadrotor import QuadrotorLimits, body_rate_squared, net_thrust
from planner_jax.trajectory.polynomial import Motion


def speed_excess(vel: Array, limits: QuadrotorLimits) -> Array:
    """|v|^2 / v_max^2 - 1 for velocities (..., 3) [m/s] (paper 002, eq. 18a)."""
    return jnp.sum(vel**2, axis=-1) / limits.speed**2 - 1.0


def acceleration_excess(acc: Array, limits: QuadrotorLimits) -> Array:
    """|a|^2 / a_max^2 - 1 for accelerations (..., 3) [m/s^2] (paper 002, eq. 18a)."""
    return jnp.sum(acc**2, axis=-1) / limits.acceleration**2 - 1.0


def body_rate_excess(acc: Array, jerk: Array, gravity: Array, limits: QuadrotorLimits) -> Array:
    """|omega|^2 / omega_max^2 - 1 by flatness (paper 002, eq. 18a)."""
    return body_rate_squared(acc, jerk, gravity) / limits.body_rate**2 - 1.0


def ground_excess(height: Array, limits: QuadrotorLimits) -> Array:
    """z_min - z [m] for heights (...) [m] (paper 000, eq. 28, without its squares).

    The squares of the print change sign below ground.
    """
    return limits.min_height - height


def motion_excess(motion: Motion, gravity: Array, limits: QuadrotorLimits) -> Array:
    """All four limits along samples of a motion, (4, N): speed, acceleration, rate, ground."""
    return jnp.stack(
        [
            speed_excess(motion.vel, limits),
            acceleration_excess(motion.acc, limits),
            body_rate_excess(motion.acc, motion.jerk, gravity, limits),
            ground_excess(motion.height, limits),
        ]
    )


def relative(squared_excess: Array) -> Array:
    """Ratio of a quantity to its limit, less one, from the same of the squares."""
    return jnp.sqrt(jnp.maximum(squared_excess + 1.0, 1e-12)) - 1.0


def thrust_excess(acc: Array, gravity: Array, least: Array, most: Array) -> Array:
    """How far the squared thrust leaves its bounds, (2, ...): 1 - f^2/least^2, f^2/most^2 - 1.

    Args:
        acc: (..., 3) [m/s^2].
        gravity: () [m/s^2].
        least: () [m/s^2], per unit mass.
        most: () [m/s^2], per unit mass.
    """
    squared = jnp.sum(net_thrust(acc, gravity) ** 2, axis=-1)
    return jnp.stack([1.0 - squared / least**2, squared / most**2 - 1.0])
