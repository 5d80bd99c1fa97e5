"""Control allocation: rotor thrusts, within their limits, for a commanded thrust and torque."""

import jax.numpy as jnp
from jax import Array, lax

from planner_jax.robot.quadrotor_model import Rotors


def rotor_thrusts(rotors: Rotors, thrust: Array, torque: Array, spare: float) -> Array:
    """Return rotor thrusts (R,) [N] that produce a thrust and a torque, within the rotors' limits.

    If the rotors cannot produce thrust and torque completely, roll and pitch have priority over
    thrust, since otherwise the thrust would point in a wrong direction. Thrust has priority over
    yaw, which does not matter for a round tool. Roll and pitch torques are scaled down if they
    would require that a rotor's thrust is raised by more than `spare`.

    Args:
        rotors: parameters of the rotors.
        thrust: () [N], along body z.
        torque: (3,) [N m], body frame.
        spare: [N], greatest increase of a rotor's thrust in favour of a torque.
    """
    least, most = rotors.min_thrust, rotors.max_thrust
    # Each rotor's fraction of a thrust that causes no torque, times R: 1 for symmetric rotors.
    num = len(rotors.places)
    share = jnp.asarray(num * rotors.shares, torque.dtype)
    inverse = jnp.asarray(rotors.mixer, torque.dtype)
    turning = jnp.matmul(inverse[:, 1:3], torque[:2], precision=lax.Precision.HIGHEST)
    lift = thrust / num * share
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
