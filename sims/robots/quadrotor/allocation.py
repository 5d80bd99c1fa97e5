"""How a wanted thrust and torque are shared among the rotors, each within what it can do."""

import jax.numpy as jnp
from jax import Array, lax

from planner_jax.robot.quadrotor_model import Rotors


def rotor_thrusts(rotors: Rotors, thrust: Array, torque: Array, spare: float) -> Array:
    """Rotor thrusts (4,) [N] that make a wrench, each within what a rotor can do.

    Where they cannot make all of it, roll and pitch go before the thrust, without which it
    would point elsewhere, and the thrust before yaw, which a round tool does not feel. Roll and
    pitch are cut where they would raise a rotor's thrust by more than is spared for them.

    Args:
        rotors: of the quadrotor.
        thrust: () [N], along body z.
        torque: (3,) [N m], body frame.
        spare: [N], by which a rotor's thrust may be raised to make room for a torque.
    """
    least, most = rotors.min_thrust, rotors.max_thrust
    # What carries the body without turning it: 1 for each rotor where all are as far away.
    share = jnp.asarray(4.0 * rotors.shares, torque.dtype)
    inverse = jnp.asarray(rotors.mixer, torque.dtype)
    turning = jnp.matmul(inverse[:, 1:3], torque[:2], precision=lax.Precision.HIGHEST)
    lift = 0.25 * thrust * share
    room = jnp.maximum(lift + spare - least, 0.0) / jnp.maximum(-turning, 1e-6)
    turning *= jnp.minimum(jnp.min(jnp.where(turning < 0.0, room, 1.0)), 1.0)
    wanted = lift + turning
    below = jnp.maximum(jnp.max((least - wanted) / share), 0.0)
    above = jnp.maximum(jnp.max((wanted - most) / share), 0.0)
    level = jnp.clip(wanted + below * share - above * share, least, most)
    yaw = inverse[:, 3] * torque[2]
    room = jnp.where(yaw > 0.0, most - level, level - least)
    part = jnp.min(room / jnp.maximum(jnp.abs(yaw), 1e-6))
    return level + jnp.minimum(part, 1.0) * yaw
