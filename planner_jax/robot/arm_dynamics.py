"""Inverse dynamics of an arm, and limits of its joint torques along motions.

Torques are found by recursive Newton-Euler, written with cumulative sums.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.core import GRAVITY
from planner_jax.robot.arm import Arm, ArmLimits, joint_axes, link_frames, product
from planner_jax.trajectory.polynomial import PiecewisePolynomial, derivative_factors

# Fraction of a torque limit that planners use. The remainder covers peaks between samples.
USED = 0.99


def inverse_dynamics(
    arm: Arm, angles: Array, velocity: Array, acceleration: Array, gravity: float | Array = GRAVITY
) -> Array:
    """Return the joint torques (n,) [N m] of a motion, without friction.

    The recursions follow [Luh1980], in the base frame. The forward recursion adds each joint's
    contribution to the motion of its link. The backward recursion adds up the forces and moments
    of the links beyond a joint; moments are about the origin of the base frame.

    Args:
        arm: one arm; the mass of its last link includes the shield.
        angles: (n,) [rad], joint angles.
        velocity: (n,) [rad/s], joint rates.
        acceleration: (n,) [rad/s^2], joint accelerations.
        gravity: () [m/s^2], magnitude, along -z of the base frame.
    """
    rotations, positions = link_frames(arm, angles)
    axes = joint_axes(arm, rotations)
    added = axes * velocity[:, None]
    spin = jnp.cumsum(added, axis=0)
    spin_rate = jnp.cumsum(axes * acceleration[:, None] + jnp.cross(spin - added, added), axis=0)

    def accelerate_points(arm_to: Array, spin: Array, spin_rate: Array) -> Array:
        return jnp.cross(spin_rate, arm_to) + jnp.cross(spin, jnp.cross(spin, arm_to))

    between = positions[1:] - positions[:-1]
    # Gravity is modelled as an upward acceleration of the base. The origin of link 1 does not move.
    first = jnp.zeros((1, 3), positions.dtype).at[0, 2].set(gravity)
    of_joints = jnp.concatenate([first, accelerate_points(between, spin[:-1], spin_rate[:-1])])
    lever = product(rotations, jnp.asarray(arm.centre)[:, :, None])[:, :, 0]
    of_centres = jnp.cumsum(of_joints, axis=0) + accelerate_points(lever, spin, spin_rate)

    force = jnp.asarray(arm.mass)[:, None] * of_centres
    inertia = product(product(rotations, jnp.asarray(arm.inertia)), jnp.swapaxes(rotations, 1, 2))
    momentum, rate = (product(inertia, turn[:, :, None])[:, :, 0] for turn in (spin, spin_rate))
    moment = rate + jnp.cross(spin, momentum) + jnp.cross(positions + lever, force)
    force, moment = (lax.cumsum(each, axis=0, reverse=True) for each in (force, moment))
    torques = jnp.sum(axes * (moment - jnp.cross(positions, force)), axis=1)
    return torques if arm.armature is None else torques + arm.armature * acceleration


def sample_states(motion: PiecewisePolynomial, num: int) -> list[Array]:
    """Return angles, rates and accelerations, each (2 M + `num`, n), of a motion of M pieces.

    The samples are both ends of each piece, at which accelerations may jump, and `num` equidistant
    times.
    """
    ends, every = jnp.cumsum(motion.durations), np.arange(len(motion.durations), dtype=np.int32)
    begins = ends - motion.durations
    times = ends[-1] * jnp.linspace(0.0, 1.0, num, dtype=ends.dtype)
    piece = jnp.sum(times[:, None] >= ends[None, :-1], axis=1, dtype=jnp.int32)
    local = jnp.concatenate([jnp.zeros_like(ends), motion.durations, times - begins[piece]])
    coeffs = motion.coeffs[jnp.concatenate([every, every, piece])]
    powers = jnp.stack([local**k for k in range(coeffs.shape[1])], axis=1)[:, :, None]
    states = []
    for order in range(3):
        factors = derivative_factors(coeffs.shape[1] - 1, order)[order:, None]
        scaled = jnp.asarray(factors, local.dtype)[None] * powers[:, : len(factors)]
        states.append(jnp.sum(coeffs[:, order:] * scaled, axis=1))
    return states


@functools.partial(jax.jit, static_argnames="num")
def measure_torques(
    arm: Arm, limits: ArmLimits, gravity: float | Array, motion: PiecewisePolynomial, num: int
) -> tuple[Array, Array, Array]:
    """Compare the torques of a motion with `USED` times their limits, at `sample_states`.

    A motion that lasts s times as long has the torque g + (tau - g) / s^2. Here tau is the torque
    of the motion, and g its part that holds the arm still.

    Returns:
        excess: (), greatest relative excess in the motion, and at standstill at its end.
        factor: () >= 1, least factor s for which the torques keep their limits.
        weak: (), greatest relative excess at standstill along the path, which no factor mends.
    """
    angles, rates, rises = sample_states(motion, num)
    still, at = jnp.zeros_like(rates), jax.vmap(inverse_dynamics, (None, 0, 0, 0, None))
    torque, held = at(arm, angles, rates, rises, gravity), at(arm, angles, still, still, gravity)
    most, moved = USED * jnp.asarray(limits.torque)[None], torque - held
    room = jnp.maximum(most - jnp.sign(moved) * held, 1e-3 * most)
    factor = jnp.sqrt(jnp.maximum(jnp.max(jnp.abs(moved) / room), 1.0))
    shares, still = jnp.abs(torque) / most, jnp.abs(held) / most
    return jnp.maximum(jnp.max(shares), jnp.max(still[-1])) - 1.0, factor, jnp.max(still) - 1.0


def stretch(motion: PiecewisePolynomial, factor: Array) -> PiecewisePolynomial:
    """Return the motion along the same path that lasts `factor` () times as long."""
    powers = factor ** jnp.arange(motion.coeffs.shape[1], dtype=factor.dtype)
    return PiecewisePolynomial(motion.coeffs / powers[None, :, None], factor * motion.durations)
