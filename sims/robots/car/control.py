"""Tracking control of the car: feedforward of the plan, and linear feedback on the path error.

Lateral feedback is a linear-quadratic regulator over distance instead of time. Per metre, the
lateral error e and the heading error psi obey e' = psi and psi' = (extra curvature). The gains
minimise the integral over distance of (e / reach)^2 + (psi / turn)^2 + (extra curvature / bend)^2,
with the weights `reach`, `turn` and `bend` of `Gains`. The gains do not depend on the speed.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.robot.car import CarPlan, knots_at, pose_at
from planner_jax.sims.robots.car.vehicle import Vehicle


@dataclasses.dataclass(frozen=True)
class Gains:
    """Gains of the car's tracking control, across and along the path; static under `jax.jit`."""

    reach: float = 0.05  # [m], lateral error that adds 1 to the regulator's cost
    turn: float = 0.15  # [rad], heading error that adds 1 to the regulator's cost
    bend: float = 0.4  # [1/m], extra curvature that adds 1 to the regulator's cost
    place: float = 4.0  # [1/s^2], acceleration per position error along the path
    speed: float = 4.0  # [1/s], acceleration per speed error

    @property
    def across(self) -> tuple[float, float]:
        """Feedback gains: added curvature per lateral error [1/m^2] and heading error [1/m]."""
        place = self.bend / self.reach
        return place, float(np.sqrt((self.bend / self.turn) ** 2 + 2.0 * place))


@struct.dataclass
class CarState:
    """Pose, speed and steering angle of the car at one instant, true or estimated."""

    pose: Array  # (3,) x, y [m] of the rear axle's centre and heading [rad]
    speed: Array  # () [m/s], along the heading
    steering: Array  # () [rad], angle of the front wheels


@struct.dataclass
class Reference:
    """The car's planned state at one instant, and inputs planned for one actuator lag later.

    The inputs are acceleration and curvature. They are taken ahead because the actuators lag.
    """

    pos: Array  # (2,) [m], position of the rear axle's centre
    heading: Array  # () [rad]
    speed: Array  # () [m/s]
    acceleration: Array  # () [m/s^2], planned for one drive lag later
    curvature: Array  # () [1/m], planned for one steering lag later
    turning: Array  # () [1/(m s)], rate of change of the curvature, one drive lag later


def reference_at(plan: CarPlan, time: Array, vehicle: Vehicle) -> Reference:
    """Return the planned state at a time [s] after the plan's start, and inputs for one lag later.

    The inputs are acceleration and curvature. A first-order lag delays a ramp by exactly its time
    constant. Inputs from one lag ahead therefore arrive in time, as long as they change slowly.
    """
    knots = plan.time, plan.speed, plan.curvature
    pose = pose_at(plan.start, *knots, time)
    step = plan.time / (plan.curvature.shape[0] - 1)
    ahead = time + vehicle.drive_lag
    before, after = (knots_at(*knots, ahead + side * step)[1] for side in (-0.5, 0.5))
    return Reference(
        pos=pose[:2],
        heading=pose[2],
        speed=knots_at(*knots, time)[0],
        acceleration=knots_at(*knots, ahead)[2],
        curvature=knots_at(*knots, time + vehicle.steering_lag)[1],
        turning=(after - before) / step,
    )


def control(state: CarState, reference: Reference, vehicle: Vehicle, gains: Gains) -> Array:
    """Return drive force [N] and steering angle [rad], (2,), that track a planned state."""
    cos, sin = jnp.cos(reference.heading), jnp.sin(reference.heading)
    away = state.pose[:2] - reference.pos
    along, across = cos * away[0] + sin * away[1], cos * away[1] - sin * away[0]
    off = state.pose[2] - reference.heading
    off = jnp.arctan2(jnp.sin(off), jnp.cos(off))
    per_place, per_heading = gains.across
    curvature = reference.curvature - per_place * across - per_heading * off
    speed_error = reference.speed - state.speed
    wanted = reference.acceleration - gains.place * along + gains.speed * speed_error
    # Rotation adds to the effective mass. With mass m, speed v, path curvature k, and yaw inertia I
    # about the rear axle, the kinetic energy is (m + I k^2) v^2 / 2.
    turning = vehicle.yaw_inertia + vehicle.mass * vehicle.mass_ahead**2
    bent = jnp.tan(state.steering) / vehicle.wheelbase
    mass = vehicle.mass + turning * bent**2
    drive = mass * wanted + turning * bent * reference.turning * state.speed
    return jnp.stack([drive, jnp.arctan(vehicle.wheelbase * curvature)])
