"""How far samples of a trajectory exceed the quadrotor's limits.

Each returns the squared quantity over its squared limit, less one: positive where the limit
is exceeded, without a square root to differentiate. `relative` turns that into the ratio of
the quantity to its limit, less one. Vectors may come as tuples of their components, as a
kernel has them.
"""

from typing import Protocol

import jax.numpy as jnp
from jax import Array

from planner_jax.arithmetic import Components, components, reciprocal
from planner_jax.robot.quadrotor import QuadrotorLimits, body_rate_squared
from planner_jax.trajectory.polynomial import Motion


class FlightLimits(Protocol):
    """Limits that every quadrotor task has."""

    @property
    def speed(self) -> Array:
        """() [m/s]."""
        ...

    @property
    def body_rate(self) -> Array:
        """() [rad/s]."""
        ...

    @property
    def min_height(self) -> Array:
        """() [m]."""
        ...


def _size_squared(vector: Components) -> Array:
    """|v|^2 of (..., 3), written out: a CPU compiles a sum over an axis into its own loop."""
    x, y, z = components(vector)
    return x * x + y * y + z * z


def speed_excess(vel: Components, limits: FlightLimits) -> Array:
    """|v|^2 / v_max^2 - 1 for velocities (..., 3) [m/s] (paper 002, eq. 18a)."""
    return _size_squared(vel) * reciprocal(limits.speed) ** 2 - 1.0


def acceleration_excess(acc: Components, limits: QuadrotorLimits) -> Array:
    """|a|^2 / a_max^2 - 1 for accelerations (..., 3) [m/s^2] (paper 002, eq. 18a)."""
    return _size_squared(acc) * reciprocal(limits.acceleration) ** 2 - 1.0


def body_rate_excess(
    acc: Components, jerk: Components, gravity: Array, limits: FlightLimits
) -> Array:
    """|omega|^2 / omega_max^2 - 1 by flatness (paper 002, eq. 18a)."""
    rate_squared = body_rate_squared(acc, jerk, gravity)
    return rate_squared * reciprocal(limits.body_rate) ** 2 - 1.0


def ground_excess(height: Array, limits: FlightLimits) -> Array:
    """z_min - z [m] for heights (...) [m] (paper 000, eq. 28, without its squares).

    The squares of the print change sign below ground.
    """
    return limits.min_height - height


def motion_excess(
    motion: Motion, gravity: Array, limits: QuadrotorLimits
) -> tuple[Array, Array, Array, Array]:
    """All four limits along samples of a motion, each (N,): speed, acceleration, rate, ground."""
    return (
        speed_excess(motion.vel, limits),
        acceleration_excess(motion.acc, limits),
        body_rate_excess(motion.acc, motion.jerk, gravity, limits),
        ground_excess(motion.height, limits),
    )


def relative(squared_excess: Array) -> Array:
    """Ratio of a quantity to its limit, less one, from the same of the squares."""
    return jnp.sqrt(jnp.maximum(squared_excess + 1.0, 1e-12)) - 1.0


def thrust_excess(
    acc: Components, gravity: Array, least: Array, most: Array
) -> tuple[Array, Array]:
    """How far the squared thrust f^2 leaves its bounds: 1 - f^2/least^2, f^2/most^2 - 1.

    Args:
        acc: (..., 3) [m/s^2].
        gravity: () [m/s^2].
        least: () [m/s^2], per unit mass.
        most: () [m/s^2], per unit mass.
    """
    x, y, z = components(acc)
    squared = _size_squared((x, y, z + gravity))
    return 1.0 - squared * reciprocal(least) ** 2, squared * reciprocal(most) ** 2 - 1.0
