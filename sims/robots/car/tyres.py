"""Lateral forces of a car's tyres, with or without slip.

The car is a single-track model, in which an axle is one wheel at its centre. The forces are solved
for together with the velocity at the end of the step (implicit Euler). Stiff tyres, and tyres at
standstill, are therefore as stable as soft tyres. A tyre that cannot slip is the limit of infinite
stiffness. World frame in the plane, SI units; velocities are of the rear axle's centre.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.sims.robots.car.vehicle import Vehicle

_STANDING = 0.05  # [m/s], least speed in the denominator of a tyre's slip angle


def tyre_forces(
    vehicle: Vehicle, pose: Array, vel: Array, steering: Array, drive: Array, timestep: float
) -> Array:
    """Return generalised forces (3,) [N, N, N m] of both axles on the rear axle's centre.

    The unknowns are the lateral forces f of the axles. Let v be the velocity, M the mass matrix, F
    the sum of other forces, and J the matrix that maps a velocity to the axles' lateral velocities.
    After a step of length h, v_after = v + h M^-1 (F + J' f). A tyre of stiffness c at speed u
    exerts f = -(c / u) J v_after.

    Args:
        vehicle: the car with its tyres.
        pose: (3,) x, y [m] of the rear axle's centre and heading [rad], at the start of the step.
        vel: (3,) [m/s, m/s, rad/s], velocity at the start of the step.
        steering: () [rad], the front wheels' angle in the middle of the step.
        drive: () [N], force along the heading, at the rear axle.
        timestep: h [s].
    """
    dtype, b = vel.dtype, vehicle.mass_ahead
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    # Mass matrix in the body frame; b is the distance of the centre of mass from the rear axle.
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
    free = own + timestep * jnp.sum(inverse * pull[None], axis=1)
    # Directions along both axles in the middle of the step, in the car's frame before the step.
    half = 0.5 * timestep * vel[2]
    zero, one = jnp.zeros((), dtype), jnp.ones((), dtype)
    front, wheelbase = steering + half, vehicle.wheelbase
    rows = jnp.stack(
        [
            jnp.stack([-jnp.sin(half), jnp.cos(half), zero]),
            jnp.stack([-jnp.sin(front), jnp.cos(front), wheelbase * jnp.cos(steering) * one]),
        ]
    )
    slip = jnp.sum(rows * free[None], axis=1)
    tyres, loads = vehicle.tyres, jnp.asarray(vehicle.loads, dtype)
    give = jnp.zeros_like(loads)  # [m/(s N)], lateral slip velocity per force, of each axle
    if tyres is not None:
        give = jnp.maximum(jnp.abs(along), _STANDING) / (tyres.stiffness * loads)
    moved = jnp.sum(rows[:, None, :] * inverse[None], axis=2)  # J M^-1, (2, 3)
    matrix = timestep * jnp.sum(moved[:, None, :] * rows[None], axis=2) + jnp.diag(give)
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
