"""How the car follows a plan: what the plan does, and linear feedback on the way.

Feedback on the errors across the way is that of the linear-quadratic regulator in distance: with
e' = psi and psi' = the extra curvature, per metre, the gains that minimise the integral of
(e / reach)^2 + (psi / turn)^2 + (extra curvature / bend)^2 do not depend on the speed; in time
they rise with it, as those of a time-varying regulator do.
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
    """What the regulator weighs; static under jit."""

    reach: float = 0.05  # [m], across the way
    turn: float = 0.15  # [rad]
    bend: float = 0.4  # [1/m]
    place: float = 4.0  # [1/s^2], acceleration per error along the way
    speed: float = 4.0  # [1/s], per error in speed

    @property
    def across(self) -> tuple[float, float]:
        """Extra curvature per error across the way [1/m^2] and in heading [1/m]."""
        place = self.bend / self.reach
        return place, float(np.sqrt((self.bend / self.turn) ** 2 + 2.0 * place))


@struct.dataclass
class CarState:
    """The car at one instant, as it is or as it is believed to be."""

    pose: Array  # (3,) x, y [m] of the rear axle's middle and heading [rad]
    speed: Array  # () [m/s], along the heading
    steering: Array  # () [rad], of the front wheels


@struct.dataclass
class Reference:
    """What is to be tracked at one instant."""

    pos: Array  # (2,) [m], of the rear axle's middle
    heading: Array  # () [rad]
    speed: Array  # () [m/s]
    acceleration: Array  # () [m/s^2], one drive lag later
    curvature: Array  # () [1/m], one steering lag later
    turning: Array  # () [1/(m s)], rate of change of that curvature


def reference_at(plan: CarPlan, time: Array, vehicle: Vehicle) -> Reference:
    """The plan at a time () [s] since its begin; what drive and steering lag behind, earlier.

    A first-order lag that is asked for a ramp gives it a lag later, and a step on average.
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
    """Drive force [N] and steering angle [rad] to ask for, (2,)."""
    cos, sin = jnp.cos(reference.heading), jnp.sin(reference.heading)
    away = state.pose[:2] - reference.pos
    along, across = cos * away[0] + sin * away[1], cos * away[1] - sin * away[0]
    off = state.pose[2] - reference.heading
    off = jnp.arctan2(jnp.sin(off), jnp.cos(off))
    per_place, per_heading = gains.across
    curvature = reference.curvature - per_place * across - per_heading * off
    speed_error = reference.speed - state.speed
    wanted = reference.acceleration - gains.place * along + gains.speed * speed_error
    # What turns with the car is to be sped up as well: of kinetic energy, m + turning k^2.
    turning = vehicle.yaw_inertia + vehicle.mass * vehicle.mass_ahead**2
    bent = jnp.tan(state.steering) / vehicle.wheelbase
    mass = vehicle.mass + turning * bent**2
    drive = mass * wanted + turning * bent * reference.turning * state.speed
    return jnp.stack([drive, jnp.arctan(vehicle.wheelbase * curvature)])
