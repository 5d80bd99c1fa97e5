"""How far an impact exceeds what is allowed of it (paper 002, eqs 21, 22 and 24)."""

import jax.numpy as jnp
from jax import Array

from planner_jax.core.arithmetic import reciprocal


def apex_excess(apex: Array, min_apex: Array, max_apex: Array) -> Array:
    """The virtual floor and roof of the returned ball (paper 002, eq. 21), relative.

    Returns:
        (2,) (H_min - H) / H_min and (H - H_max) / H_max.
    """
    return jnp.stack([1.0 - apex * reciprocal(min_apex), apex * reciprocal(max_apex) - 1.0])


def hitting_speed_excess(vel: Array, limit: Array) -> Array:
    """v_j^2 / v_max,j^2 - 1 on each world axis (paper 002, eq. 24), shape (3,)."""
    return (vel * reciprocal(limit)) ** 2 - 1.0
