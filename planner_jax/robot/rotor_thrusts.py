"""Thrusts that the rotors of a quadrotor need for a motion, for limits of single rotors."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array

from planner_jax.core.arithmetic import Components, at_least, components
from planner_jax.robot.quadrotor import RotorLimits, body_rate


def rotor_thrusts(
    acc: Components,
    jerk: Components,
    snap: Components,
    gravity: Array,
    rotors: RotorLimits,
    pull: Array | None = None,
    turn: tuple[Array, Array, Array] | None = None,
) -> tuple[Array, ...]:
    """Return the thrusts (...) [N] that R rotors need for a motion.

    Acceleration [m/s^2], jerk [m/s^3] and snap [m/s^4] are (..., 3), gravity is () [m/s^2]. `pull`
    is the thrust per unit mass (...) [m/s^2], by default |acceleration + gravity e_3|. `turn` has
    the heading and its two derivatives (...), by default the constant `rotors.heading`.
    """
    a, j, s = (tuple(components(each)) for each in (acc, jerk, snap))
    rate, turning = jax.jvp(lambda acc, jerk: body_rate(acc, jerk, gravity), (a, j), (j, s))
    if turn is None and rotors.heading is not None:
        turn = rotors.heading, jnp.zeros_like(rate[2]), jnp.zeros_like(rate[2])
    if turn is not None:
        angle, speed, growth = turn
        rate = (*turn_back(angle, rate), rate[2] + speed)
        across, against = turn_back(angle, turning)
        turning = (across + speed * rate[1], against - speed * rate[0], turning[2] + growth)
    x, y, z = a
    if pull is None:
        pull = jnp.sqrt(at_least(x * x + y * y + (z + gravity) ** 2, 1e-4))
    thrust = rotors.mass * pull
    about_x, about_y, about_z = (rotors.inertia[..., k] for k in range(3))
    roll = about_x * turning[0] + (about_z - about_y) * rate[1] * rate[2]
    pitch = about_y * turning[1] + (about_x - about_z) * rate[2] * rate[0]
    yaw = about_z * turning[2] + (about_y - about_x) * rate[0] * rate[1]
    if rotors.inertia.shape[-1] == 6:  # the matrix P of the products adds  P w' + w x P w
        xy, xz, yz = (rotors.inertia[..., k] for k in range(3, 6))
        (own, bent) = (
            (xy * v[1] + xz * v[2], xy * v[0] + yz * v[2], xz * v[0] + yz * v[1])
            for v in (rate, turning)
        )
        roll += bent[0] + rate[1] * own[2] - rate[2] * own[1]
        pitch += bent[1] + rate[2] * own[0] - rate[0] * own[2]
        yaw += bent[2] + rate[0] * own[1] - rate[1] * own[0]
    rows = (rotors.mixer[..., i, :] for i in range(rotors.mixer.shape[-2]))
    return tuple(
        row[..., 0] * thrust + row[..., 1] * roll + row[..., 2] * pitch + row[..., 3] * yaw
        for row in rows
    )


def turn_back(heading: Array, vector: Sequence[Array]) -> tuple[Array, Array]:
    """Return the x and y components of  R_z(-psi) v  for headings psi [rad] and vectors v."""
    cosine, sine = jnp.cos(heading), jnp.sin(heading)
    return cosine * vector[0] + sine * vector[1], cosine * vector[1] - sine * vector[0]
