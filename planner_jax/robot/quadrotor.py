"""Quadrotor limits and differential flatness (paper 002, eq. 1; attitude by the Hopf fibration).

The body z axis follows the net thrust  tau = a + g e_3  (per unit mass). With the heading
held at zero, the Hopf fibration gives the body rates from tau and the jerk alone
(Watterson and Kumar, "Control of quadrotors using the Hopf fibration on SO(3)").
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.arithmetic import Components, at_least, components, inverse_sqrt, reciprocal


@struct.dataclass
class QuadrotorLimits:
    """What the quadrotor may not exceed."""

    speed: Array  # () [m/s]
    acceleration: Array  # () [m/s^2]
    body_rate: Array  # () [rad/s]
    min_height: Array  # () [m], of the propeller plane

    def scaled(self, factor: float) -> "QuadrotorLimits":
        """Speed, acceleration and body-rate limits times `factor`; the ground stays."""
        return dataclasses.replace(
            self,
            speed=self.speed * factor,
            acceleration=self.acceleration * factor,
            body_rate=self.body_rate * factor,
        )


def net_thrust(acc: Array, gravity: Array) -> Array:
    """Thrust per unit mass  a + g e_3  [m/s^2], shape (..., 3)."""
    return acc + gravity * jnp.array([0.0, 0.0, 1.0], acc.dtype)


def body_z(acc: Array, gravity: Array) -> Array:
    """Unit vector along the net thrust, shape (..., 3); zero where there is no thrust."""
    thrust = net_thrust(acc, gravity)
    size_squared = jnp.sum(thrust**2, axis=-1, keepdims=True)
    pushing = size_squared > 0.0
    return jnp.where(pushing, thrust / jnp.sqrt(jnp.where(pushing, size_squared, 1.0)), 0.0)


def body_rate_squared(acc: Components, jerk: Components, gravity: Array) -> Array:
    """Squared body rate  |omega|^2  of the Hopf fibration at zero heading [rad^2/s^2].

    |z'|^2 + ((z_y z_x' - z_x z_y') / (1 + z_z))^2 , where z' is the jerk across the thrust
    over the thrust's size. Written without square roots, so that its gradient is finite
    wherever the value is.

    Args:
        acc: (..., 3) [m/s^2].
        jerk: (..., 3) [m/s^3].
        gravity: () [m/s^2].

    Returns:
        (...,). Near free fall (no thrust) and upside down, where the attitude is not
        defined, the value is large but finite.
    """
    # Component by component, and each reciprocal once: sums over an axis of three and
    # divisions are what a CPU spends most of a plan's time on.
    tx, ty, az = components(acc)
    tz = az + gravity
    jx, jy, jz = components(jerk)
    size_squared = at_least(tx * tx + ty * ty + tz * tz, 1e-4)
    inverse_size = inverse_sqrt(size_squared)
    inverse_squared = inverse_size * inverse_size
    along = tx * jx + ty * jy + tz * jz
    tilt_squared = (jx * jx + jy * jy + jz * jz - along * along * inverse_squared) * inverse_squared
    # z_y z_x' - z_x z_y' = (tau_y j_x - tau_x j_y) / |tau|^2 : the part along tau drops out.
    twist = (ty * jx - tx * jy) * inverse_size
    twist = twist * reciprocal(at_least(size_squared * inverse_size + tz, 1e-2))
    return tilt_squared + twist * twist


def tangent_basis(normal: Array) -> tuple[Array, Array]:
    """The body x and y axes of the Hopf fibration at zero heading.

    Args:
        normal: (3,) body z axis, unit length.

    Returns:
        Two (3,) unit vectors across `normal`, smooth except at straight down.
    """
    x, y, z = components(normal)
    k = reciprocal(at_least(1.0 + z, 1e-6))
    return (
        jnp.stack([1.0 - k * x * x, -k * x * y, -x]),
        jnp.stack([-k * x * y, 1.0 - k * y * y, -y]),
    )


def flat_attitude(acc: Array, jerk: Array, gravity: Array) -> tuple[Array, Array]:
    """Attitude and body rate of a motion, at zero heading of the Hopf fibration.

    Args:
        acc: (3,) [m/s^2].
        jerk: (3,) [m/s^3].
        gravity: () [m/s^2], magnitude.

    Returns:
        (3, 3) rotation, body to world, and (3,) [rad/s] in the body frame.
    """
    z = body_z(acc, gravity)
    size = jnp.sqrt(jnp.maximum(jnp.sum(net_thrust(acc, gravity) ** 2), 1e-2))
    z_dot = (jerk - jnp.sum(jerk * z) * z) / size
    x, y = tangent_basis(z)
    twist = (z[1] * z_dot[0] - z[0] * z_dot[1]) / jnp.maximum(1.0 + z[2], 1e-2)
    rate = jnp.stack([-jnp.sum(y * z_dot), jnp.sum(x * z_dot), twist])
    return jnp.stack([x, y, z], axis=1), rate


def tilt_quaternion(normal: Array) -> Array:
    """The attitude at zero heading of the Hopf fibration, of the body z axis, (4,) w x y z.

    The shortest turn from upright: (1 + z, -y, x, 0) / sqrt(2 (1 + z)).
    """
    x, y, z = components(normal)
    w = jnp.sqrt(0.5 * at_least(1.0 + z, 1e-6))
    return jnp.stack([w, -0.5 * y / w, 0.5 * x / w, jnp.zeros_like(w)])
