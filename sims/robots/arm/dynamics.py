"""Inverse dynamics of an arm by recursive Newton-Euler, written with cumulative sums."""

import jax.numpy as jnp
from jax import Array, lax

from planner_jax.robot.arm import Arm, joint_axes, link_frames, product


def inverse_dynamics(
    arm: Arm, angles: Array, velocity: Array, acceleration: Array, gravity: float | Array = 9.81
) -> Array:
    """Return the joint torques (6,) [N m] of a motion, without friction and rotor inertia.

    The recursions follow [Luh1980], in the base frame. The forward recursion adds each joint's
    contribution to the motion of its link. The backward recursion adds up the forces and moments
    of the links beyond a joint; moments are about the origin of the base frame.

    Args:
        arm: one arm; the shield has no mass of its own.
        angles: (6,) [rad], joint angles.
        velocity: (6,) [rad/s], joint rates.
        acceleration: (6,) [rad/s^2], joint accelerations.
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
    return jnp.sum(axes * (moment - jnp.cross(positions, force)), axis=1)
