"""The bounce of a ball on a moving racket (paper 002, eqs 3, 11 and 12)."""

import jax.numpy as jnp
from jax import Array

from planner_jax.core.arithmetic import inverse_sqrt, reciprocal


def racket_impact(ball_vel: Array, racket_vel: Array, normal: Array, restitution: Array) -> Array:
    """Ball velocity after the bounce.

    v+ = v- - (1 + beta) ((v- - u) . z) z . Paper 002, eq. 3 prints (1 - beta); its own
    definition of beta and its eq. 12 need the plus sign. The tangential velocity is kept.

    Args:
        ball_vel: (3,) v- [m/s].
        racket_vel: (3,) u [m/s].
        normal: (3,) z, unit normal of the racket.
        restitution: () beta, 0 to 1.

    Returns:
        (3,) v+ [m/s].
    """
    return ball_vel - (1.0 + restitution) * jnp.sum((ball_vel - racket_vel) * normal) * normal


def required_impact(
    ball_vel: Array, ball_vel_after: Array, restitution: Array
) -> tuple[Array, Array]:
    """Racket normal and normal speed that turn one ball velocity into another.

    Paper 002, eq. 11 (the normal points along v+ - v-; the print has it reversed) and eq. 12.

    Args:
        ball_vel: (3,) v- [m/s].
        ball_vel_after: (3,) v+ [m/s], different from v-.
        restitution: () beta.

    Returns:
        normal: (3,) unit vector.
        normal_speed: () [m/s], of the racket along `normal`.
    """
    change = ball_vel_after - ball_vel
    size_squared = jnp.sum(change**2)
    distinct = size_squared > 0.0
    normal = change * inverse_sqrt(jnp.where(distinct, size_squared, 1.0))
    mean = (restitution * ball_vel + ball_vel_after) * reciprocal(1.0 + restitution)
    normal_speed = jnp.sum(mean * normal)
    return normal, normal_speed
