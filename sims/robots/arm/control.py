"""How an arm follows a plan: the torques that the motion needs, and feedback on what is off.

Computed torque: inverse dynamics are asked for the acceleration of the plan and, on top of it,
one that takes away the errors of angle and rate like a spring and a damper, the same for all
joints whatever their inertia.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.robot.arm import Arm
from planner_jax.sims.robots.arm.dynamics import inverse_dynamics
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate, total_duration


@dataclasses.dataclass(frozen=True)
class Gains:
    """The feedback; static under jit."""

    frequency: float = 50.0  # [rad/s], of an error that dies out
    damping: float = 1.0  # 1 for the fastest way without swinging over


@struct.dataclass
class Course:
    """A motion of the joints, from when on it is followed, and how it is brought to an end."""

    motion: PiecewisePolynomial  # (M, D + 1, 6) [rad]
    begin: Array  # () [s]
    braking: Array  # (6,) [rad/s^2], of joints that turn when the motion ends


@struct.dataclass
class JointState:
    """The joints at one instant, as they are or as they are read."""

    angles: Array  # (6,) [rad]
    rates: Array  # (6,) [rad/s]


@struct.dataclass
class JointReference:
    """What is to be tracked at one instant."""

    angles: Array  # (6,) [rad]
    rates: Array  # (6,) [rad/s]
    accelerations: Array  # (6,) [rad/s^2]


def reference_at(course: Course, time: Array) -> JointReference:
    """Return the course at a time () [s].

    Before it begins the joints turn as evenly as they do when it does, mostly not at all. Where it
    ends each joint brakes evenly, and stays where it stands.
    """
    motion = course.motion
    elapsed, end = time - course.begin, total_duration(motion)
    within = jnp.clip(elapsed, 0.0, end)
    angles, rates, accelerations = (evaluate(motion, within, order) for order in range(3))
    early, late = jnp.minimum(elapsed, 0.0), jnp.maximum(elapsed - end, 0.0)
    stands = jnp.abs(rates) / course.braking  # [s], after the end
    brake = jnp.where(late > 0.0, -jnp.sign(rates) * course.braking, 0.0)
    braked = jnp.minimum(late, stands)
    beyond = (elapsed < 0.0) | (elapsed >= end)
    return JointReference(
        angles=angles + rates * (early + braked) + 0.5 * brake * braked**2,
        rates=rates + brake * braked,
        accelerations=jnp.where(beyond, jnp.where(late < stands, brake, 0.0), accelerations),
    )


def control(
    state: JointState, reference: JointReference, arm: Arm, gains: Gains, gravity: float
) -> Array:
    """Return torques (6,) [N m] to ask for, of an arm as it is believed to be."""
    angle_error, rate_error = reference.angles - state.angles, reference.rates - state.rates
    wanted = (
        reference.accelerations
        + 2.0 * gains.damping * gains.frequency * rate_error
        + gains.frequency**2 * angle_error
    )
    return inverse_dynamics(arm, state.angles, state.rates, wanted, gravity)
