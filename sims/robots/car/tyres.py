"""Lateral forces of a car's tyres: those that hinder slip, or those that slip makes.

The single-track model: an axle is one wheel in its middle. Forces are found together with the
velocity at the end of the step that they act in (implicit Euler), so that stiff tyres, and tyres
at rest, are as stable as soft ones; a tyre that cannot slip is the limit of a stiff one. World
frame in the plane, SI units; velocities are those of the rear axle's middle.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.sims.robots.car.vehicle import Vehicle

_STANDING = 0.05  # [m/s], below which a tyre's slip angle is taken at this speed


def tyre_forces(
    vehicle: Vehicle, pose: Array, vel: Array, steering: Array, drive: Array, timestep: float
) -> Array:
    """Generalised forces (3,) [N, N, N m] of both axles on the rear axle's middle.

    Unknown are the lateral forces f of the axles. With mass matrix M, forces F of everything else
    and rows J that give the axles' lateral velocities, the velocity after the step of length h is
    v + h M^-1 (F + J' f); a tyre of stiffness c at speed u then bears  f = -(c / u) J v_after.

    Args:
        vehicle: with its tyres.
        pose: (3,) x, y [m] of the rear axle's middle and heading [rad], half a step ago from the
            middle of the step.
        vel: (3,) [m/s, m/s, rad/s].
        steering: () [rad], the front wheels' angle in the middle of the step.
        drive: () [N], along the heading, at the rear axle.
        timestep: h [s].
    """
    dtype, b = vel.dtype, vehicle.mass_ahead
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    # M turned into the heading has one pair of coupled entries, m b between sway and yaw.
    coupling, turning = vehicle.mass * b, vehicle.yaw_inertia + vehicle.mass * b**2
    determinant = vehicle.mass * turning - coupling**2
    inverse = np.array(
        [
            [1.0 / vehicle.mass, 0.0, 0.0],
            [0.0, turning / determinant, -coupling / determinant],
            [0.0, -coupling / determinant, vehicle.mass / determinant],
        ]
    )
    inverse = jnp.asarray(inverse, dtype)
    along = cos * vel[0] + sin * vel[1]
    own = jnp.stack([along, cos * vel[1] - sin * vel[0], vel[2]])
    pull = jnp.stack([drive + coupling * vel[2] ** 2, jnp.zeros((), dtype), jnp.zeros((), dtype)])
    free = own + timestep * jnp.sum(inverse * pull, axis=1)
    # Rows in the frame of the heading in the middle of the step.
    half = 0.5 * timestep * vel[2]
    zero, one = jnp.zeros((), dtype), jnp.ones((), dtype)
    front, wheelbase = steering + half, vehicle.wheelbase
    rows = jnp.stack(
        [
            jnp.stack([-jnp.sin(half), jnp.cos(half), zero]),
            jnp.stack([-jnp.sin(front), jnp.cos(front), wheelbase * jnp.cos(steering) * one]),
        ]
    )
    slip = jnp.sum(rows * free, axis=1)
    tyres, loads = vehicle.tyres, jnp.asarray(vehicle.loads, dtype)
    give = jnp.zeros_like(loads)  # of each axle, slip per force
    if tyres is not None:
        give = jnp.maximum(jnp.abs(along), _STANDING) / (tyres.stiffness * loads)
    moved = jnp.sum(rows[:, None, :] * inverse, axis=2)  # J M^-1, (2, 3)
    matrix = timestep * jnp.sum(moved[:, None, :] * rows, axis=2) + jnp.diag(give)
    a, c, d = matrix[0, 0], matrix[0, 1], matrix[1, 1]
    solved = jnp.stack([d * slip[0] - c * slip[1], a * slip[1] - c * slip[0]])
    force = -solved / (a * d - c * c)
    if tyres is not None:
        most = tyres.friction * loads
        force = jnp.clip(force, -most, most)
    pushed = jnp.sum(rows * force[:, None], axis=0)
    return jnp.stack(
        [cos * pushed[0] - sin * pushed[1], sin * pushed[0] + cos * pushed[1], pushed[2]]
    )
