"""Quadrotor limits and differential flatness (paper 002, eq. 1; attitude by the Hopf fibration).

The body z axis follows the net thrust  tau = a + g e_3  (per unit mass). With the heading
held at zero, the Hopf fibration gives the body rates from tau and the jerk alone
(Watterson and Kumar, "Control of quadrotors using the Hopf fibration on SO(3)").
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax import Array


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


def body_rate_squared(acc: Array, jerk: Array, gravity: Array) -> Array:
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
    thrust = net_thrust(acc, gravity)
    size_squared = jnp.maximum(jnp.sum(thrust**2, axis=-1), 1e-4)
    size = jnp.sqrt(size_squared)
    along = jnp.sum(thrust * jerk, axis=-1)
    tilt_squared = (jnp.sum(jerk**2, axis=-1) - along**2 / size_squared) / size_squared
    # z_y z_x' - z_x z_y' = (tau_y j_x - tau_x j_y) / |tau|^2 : the part along tau drops out.
    twist = (thrust[..., 1] * jerk[..., 0] - thrust[..., 0] * jerk[..., 1]) / size
    twist = twist / jnp.maximum(size + thrust[..., 2], 1e-2)
    return tilt_squared + twist**2


def tangent_basis(normal: Array) -> tuple[Array, Array]:
    """The body x and y axes of the Hopf fibration at zero heading.

    Args:
        normal: (3,) body z axis, unit length.

    Returns:
        Two (3,) unit vectors across `normal`, smooth except at straight down.
    """
    x, y, z = normal[0], normal[1], normal[2]
    k = 1.0 / jnp.maximum(1.0 + z, 1e-6)
    return (
        jnp.stack([1.0 - k * x * x, -k * x * y, -x]),
        jnp.stack([-k * x * y, 1.0 - k * y * y, -y]),
    )
