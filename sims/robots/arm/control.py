"""Tracking control of an arm by computed torque.

The commanded acceleration is the planned acceleration plus feedback. The feedback acts on the
errors of angle and rate like a spring and a damper, with equal gains for all joints. Inverse
dynamics then give the torques of the commanded acceleration.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.robot.arm import Arm
from planner_jax.robot.arm_dynamics import inverse_dynamics
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate, total_duration


@dataclasses.dataclass(frozen=True)
class Gains:
    """Feedback gains of the arm's controller; static under `jax.jit`."""

    frequency: float = 50.0  # [rad/s], natural frequency of the error dynamics
    damping: float = 1.0  # damping ratio; 1 for the fastest response without overshoot


@struct.dataclass
class Course:
    """A motion of n joints with its start time, and how the joints brake after its end."""

    motion: PiecewisePolynomial  # (M, D + 1, n) [rad], joint angles as M pieces of degree D
    begin: Array  # () [s], start time of the motion
    braking: Array  # (n,) [rad/s^2], deceleration of joints that still move when the motion ends


@struct.dataclass
class JointState:
    """Angles and rates of the joints at one instant: true, measured or estimated."""

    angles: Array  # (n,) [rad]
    rates: Array  # (n,) [rad/s]


@struct.dataclass
class JointReference:
    """The planned angles, rates and accelerations of the joints at one instant."""

    angles: Array  # (n,) [rad]
    rates: Array  # (n,) [rad/s]
    accelerations: Array  # (n,) [rad/s^2]


def reference_at(course: Course, time: Array) -> JointReference:
    """Return the planned state of the joints at a time () [s] of a course (a timed motion).

    Before the motion starts, each joint moves at its initial rate, which is mostly zero. After the
    motion's end each joint brakes at a constant deceleration, and then stands still.
    """
    motion = course.motion
    elapsed, end = time - course.begin, total_duration(motion)
    within = jnp.clip(elapsed, 0.0, end)
    angles, rates, accelerations = (evaluate(motion, within, order) for order in range(3))
    early, late = jnp.minimum(elapsed, 0.0), jnp.maximum(elapsed - end, 0.0)
    stands = jnp.abs(rates) / course.braking  # [s], from the end of the motion to standstill
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
    """Return joint torques (n,) [N m] that track a planned state, by the dynamics of `arm`."""
    angle_error, rate_error = reference.angles - state.angles, reference.rates - state.rates
    wanted = (
        reference.accelerations
        + 2.0 * gains.damping * gains.frequency * rate_error
        + gains.frequency**2 * angle_error
    )
    return inverse_dynamics(arm, state.angles, state.rates, wanted, gravity)
