"""Apex of the returned ball, and excesses of the apex and of the hitting speed."""

import jax.numpy as jnp
from jax import Array

from planner_jax.ball.flight import BallState, drag_free_apex
from planner_jax.cost import penalty


def apex(pos: Array, vel: Array, gravity: Array, printed: bool = False) -> Array:
    """Return the greatest future height () [m] of a ball without drag [Yu2023bat, eq. 22].

    `pos` (3,) [m] and `vel` (3,) [m/s] are the ball's state after the hit, `gravity` is in m/s^2.
    With `printed=True` the result is z + v_x^2 / (2 g), as printed, instead of z + v_z^2 / (2 g).
    """
    if printed:
        return pos[2] + vel[0] ** 2 / (2.0 * gravity)
    return drag_free_apex(BallState(pos, vel), gravity)


def apex_excess(apex: Array, least: Array, most: Array, in_si: bool = False) -> Array:
    """Return how far an apex H () is below and above its bounds, (2,) [Yu2023bat, eq. 21].

    The excesses are 1 - H / H_min and H / H_max - 1; with `in_si=True` H_min - H and H - H_max [m].
    """
    if in_si:
        return jnp.stack([least - apex, apex - most])
    return penalty.apex_excess(apex, least, most)


def hitting_speed_excess(vel: Array, most: Array, in_si: bool = False) -> Array:
    """Return how far the velocity (3,) at the hit exceeds its limits (3,) [Yu2023bat, eq. 24a].

    The excess is v_j^2 / v_max,j^2 - 1; with `in_si=True` it is |v_j| - v_max,j [m/s].
    """
    return jnp.abs(vel) - most if in_si else penalty.hitting_speed_excess(vel, most)
