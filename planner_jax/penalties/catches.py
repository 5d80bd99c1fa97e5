"""Distance of a ball from the centre of a net, and excess of the angle between net and ball."""

import jax.numpy as jnp
from jax import Array


def length(vector: Array) -> Array:
    """Return the lengths (...) of vectors (..., 3), with a zero gradient at zero vectors."""
    squared = jnp.sum(vector**2, axis=-1)
    moving = squared > 0.0
    return jnp.where(moving, jnp.sqrt(jnp.where(moving, squared, 1.0)), 0.0)


def net_distance(pos: Array, axis: Array, ball_pos: Array, height: Array) -> Array:
    """Return the distance (...) [m] of the ball from the net's centre [Yu2023catch, eq. 22].

    The net is at the distance `height` [m] from the quadrotor's position (..., 3) [m] along its
    unit axis (..., 3). The printed equation has the net at the distance -height.
    """
    return length(pos + height * axis - ball_pos)


def facing_cosine(axis: Array, vel: Array) -> tuple[Array, Array]:
    """Return cosines (...) of angles between net axes and -`vel`, and whether `vel` is not zero."""
    speed_squared = jnp.sum(vel**2, axis=-1)
    moving = speed_squared > 1e-12
    speed = jnp.sqrt(jnp.where(moving, speed_squared, 1.0))
    return -jnp.sum(axis * vel, axis=-1) / speed, moving


def net_angle_excess(axis: Array, ball_vel: Array, max_angle: Array) -> Array:
    """Return cos(greatest angle) - cos(angle of net and ball), (...) [Yu2023catch, eq. 25].

    The angle is between the net's unit axis (..., 3) and the reversed velocity of the ball (..., 3)
    [m/s]; the printed equation has the velocity itself. `max_angle` is in rad. The excess is -1 for
    a ball at standstill.
    """
    facing, moving = facing_cosine(axis, ball_vel)
    return jnp.where(moving, jnp.cos(max_angle) - facing, -1.0)
