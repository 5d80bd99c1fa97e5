"""Excesses of a quadrotor's motion over its limits, relative or in squared SI units.

An excess is q^2 / limit^2 - 1 for a quantity q; with `in_si=True` it is q^2 - limit^2. Vectors are
(..., 3) in the world frame, with z up; the results are (...,).
"""

import jax.numpy as jnp
from jax import Array

from planner_jax.core.arithmetic import Components, components
from planner_jax.cost import quadrotor
from planner_jax.cost.quadrotor import tilt_excess as tilt_excess
from planner_jax.robot.quadrotor import body_rate_squared


def speed_excess(vel: Components, most: Array, in_si: bool = False) -> Array:
    """Return the excess of velocities [m/s] over `most` [Yu2023catch, eq. 27a].

    In [Yu2023bat, eq. 18a] the limit is printed without its square.
    """
    excess = quadrotor.speed_excess(vel, most)
    return excess * most**2 if in_si else excess


def acceleration_excess(acc: Components, most: Array, in_si: bool = False) -> Array:
    """Return the excess of accelerations [m/s^2] over `most` [Yu2023bat, eq. 18a]."""
    excess = quadrotor.acceleration_excess(acc, most)
    return excess * most**2 if in_si else excess


def body_rate_excess(
    acc: Components, jerk: Components, gravity: Array, most: Array, in_si: bool = False
) -> Array:
    """Return the excess of body rates over `most` [rad/s], by [Yu2023catch, eq. 27a].

    The body rate follows from acceleration [m/s^2], jerk [m/s^3] and `gravity` [m/s^2].
    """
    if in_si:
        return body_rate_squared(acc, jerk, gravity) - most**2
    return quadrotor.body_rate_excess(acc, jerk, gravity, most)


def thrust_excess(
    acc: Components, gravity: Array, least: Array, most: Array, in_si: bool = False
) -> tuple[Array, Array]:
    """Return the excesses of the thrust below `least` and above `most` [Yu2023catch, eq. 27a].

    The thrust is per unit mass [m/s^2]: the norm of acceleration plus `gravity` upwards.
    """
    below, above = quadrotor.thrust_excess(acc, gravity, least, most)
    return (below * least**2, above * most**2) if in_si else (below, above)


def thrust_band_excess(acc: Components, gravity: Array, least: Array, most: Array) -> Array:
    """Return the excess of thrusts over their limits, (...) [m^2/s^4]; <= 0 within the limits.

    The excess is (f - middle)^2 - half^2, as in the code published with [Yu2023catch]. f is the
    thrust per unit mass for accelerations `acc` (..., 3). `middle` is the mean of the limits
    `least` and `most` [m/s^2], and `half` is half of their difference.
    """
    x, y, z = components(acc)
    z = z + gravity
    thrust = jnp.sqrt(jnp.maximum(x * x + y * y + z * z, 1e-6))
    middle, half = 0.5 * (most + least), 0.5 * (most - least)
    return (thrust - middle) ** 2 - half**2


def ground_excess(height: Array, least: Array, printed: bool = False) -> Array:
    """Return z_min - z [m] for heights z [m] and z_min = `least` [Yu2023catch, eq. 28].

    The printed excess z_min^2 - z^2 [m^2] is not positive below -z_min, where it should be.
    """
    return least**2 - height**2 if printed else quadrotor.ground_excess(height, least)
