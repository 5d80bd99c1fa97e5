"""The simulated car, a `sims.robot.Robot`: two slides and a hinge in the plane.

`qpos` starts with x, y of the rear axle's centre and the heading, `qvel` with their rates, in the
world frame. A force with a first-order lag drives the rear wheels. The steering angle is the state
of an actuator that integrates a commanded rate; angle and rate are limited. The lateral tyre forces
(`tyres.py`) act in addition to the actuators.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.sims.model import World
from planner_jax.sims.robot import Physics, Shape
from planner_jax.sims.robots.car.control import CarState, Gains, Reference, control, reference_at
from planner_jax.sims.robots.car.tyres import tyre_forces
from planner_jax.sims.robots.car.vehicle import Vehicle
from planner_jax.sims.scenery import VISUAL, xml_numbers

_HEIGHT = 0.1  # [m], height of the body
_CLEARANCE = 0.03  # [m], clearance of the body above the ground


@dataclasses.dataclass(frozen=True)
class Car:
    """The simulated car with rear drive and front steering; static under `jax.jit`."""

    vehicle: Vehicle = Vehicle()
    gains: Gains = Gains()

    WORDS: ClassVar[str] = (
        "a car with tyre forces, lag and limits of drive and steering, path-tracking feedback"
    )
    num_pos, num_vel, noise_shape = 3, 3, (3,)

    def mjcf(self) -> tuple[str, str]:
        """Return two MJCF texts: the body with wheels, and the actuators of drive and steering."""
        vehicle = self.vehicle
        middle = 0.5 * vehicle.length - vehicle.rear_overhang
        body = np.array([0.5 * vehicle.length, 0.5 * vehicle.width, 0.5 * _HEIGHT])
        wheels = "".join(
            f'<geom type="cylinder" size="{xml_numbers(vehicle.wheel_radius, 0.015)}" '
            f'pos="{xml_numbers(*place)}" quat=".7071068 .7071068 0 0" rgba=".1 .1 .1 1" {VISUAL}/>'
            for place in self._wheels()
        )
        force = vehicle.mass * vehicle.acceleration
        actuators = (
            f'<general site="rear_axle" gear="1 0 0 0 0 0" ctrllimited="true" '
            f'ctrlrange="{xml_numbers(-force, force)}" dyntype="filterexact" '
            f'dynprm="{xml_numbers(vehicle.drive_lag)}"/>'
            f'<general joint="heading" gainprm="0" dyntype="integrator" ctrllimited="true" '
            f'ctrlrange="{xml_numbers(-vehicle.steering_rate, vehicle.steering_rate)}" '
            f'actlimited="true" actrange="{xml_numbers(-vehicle.steering, vehicle.steering)}"/>'
        )
        text = (
            '<body name="car"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
            '<joint name="heading" type="hinge" axis="0 0 1"/>'
            f'<inertial pos="{xml_numbers(vehicle.mass_ahead, 0.0, vehicle.wheel_radius)}" '
            f'mass="{vehicle.mass}" diaginertia="{xml_numbers(*[vehicle.yaw_inertia] * 3)}"/>'
            f'<site name="rear_axle"/><geom type="box" size="{xml_numbers(*body)}" '
            f'pos="{xml_numbers(middle, 0.0, _CLEARANCE + 0.5 * _HEIGHT)}" rgba=".2 .4 .8 1" '
            f"{VISUAL}/>{wheels}</body>"
        )
        return text, actuators

    def _wheels(self) -> np.ndarray:
        vehicle = self.vehicle
        aside = 0.5 * vehicle.width - 0.015
        ends = [(x, y) for x in (0.0, vehicle.wheelbase) for y in (-aside, aside)]
        return np.array([(x, y, vehicle.wheel_radius) for x, y in ends])

    def at_rest(self, place: Array, gravity: float) -> tuple[Array, Array, Array]:
        """Return pose (3,), rates (3,) and actuator states (2,) of a car at rest at `place` [m]."""
        none = jnp.zeros(3, place.dtype)
        return none.at[:2].set(place[:2]), none, none[:2]

    def moving(self, pose: Array, speed: Array, curvature: Array) -> Physics:
        """Return the state at a pose (3,), speed () [m/s] and path curvature () [1/m].

        The state is of a world without balls.
        """
        ahead = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2]), curvature])
        steering = jnp.arctan(self.vehicle.wheelbase * curvature)
        return Physics(
            qpos=pose, qvel=speed * ahead, act=jnp.stack([jnp.zeros_like(speed), steering])
        )

    def drive(self, physics: Physics, command: Array, timestep: float) -> tuple[Array, Array]:
        """Return MuJoCo's controls (drive force, rate of the steering angle), and tyre forces (3,).

        Args:
            physics: state before the step.
            command: (2,), commanded drive force [N] and steering angle [rad].
            timestep: [s].
        """
        vehicle = self.vehicle
        drive, steering = physics.act
        asked = jnp.clip(command[1], -vehicle.steering, vehicle.steering)
        rate = (asked - steering) / vehicle.steering_lag
        rate = jnp.clip(rate, -vehicle.steering_rate, vehicle.steering_rate)
        forces = tyre_forces(
            vehicle,
            physics.qpos[:3],
            physics.qvel[:3],
            steering + 0.5 * timestep * rate,
            drive,
            timestep,
        )
        return jnp.stack([command[0], rate]), forces

    def saturation(self, physics: Physics, command: Array) -> Array:
        """Return whether drive force, and steering angle or rate, exceed limits, (2,) bool."""
        vehicle = self.vehicle
        rate = (command[1] - physics.act[1]) / vehicle.steering_lag
        fast = jnp.abs(rate) > vehicle.steering_rate
        force = vehicle.mass * vehicle.acceleration
        return jnp.stack(
            [jnp.abs(command[0]) > force, fast | (jnp.abs(command[1]) > vehicle.steering)]
        )

    def state(self, physics: Physics) -> CarState:
        """Return the true pose, speed and steering angle from the simulated physics."""
        heading, vel = physics.qpos[2], physics.qvel
        return CarState(
            pose=physics.qpos[:3],
            speed=jnp.cos(heading) * vel[0] + jnp.sin(heading) * vel[1],
            steering=physics.act[1],
        )

    def sense(self, state: CarState, noise: Array, stds: Any) -> CarState:
        """Return the car's estimated state: the true state plus random errors in the pose.

        Args:
            state: the true state.
            noise: (3,) standard normal.
            stds: (2,), standard deviations of a coordinate [m] and of the heading [rad].
        """
        errors = jnp.asarray(stds, noise.dtype)[np.array([0, 0, 1])] * noise
        return dataclasses.replace(state, pose=state.pose + errors)

    def references(self, plan: Any, times: Array, world: World) -> Reference:
        """Return the references (planned states) at K times [s] since the start of a plan."""
        return jax.vmap(lambda time: reference_at(plan, time, self.vehicle))(times)

    def command(self, state: CarState, reference: Reference, world: World) -> Array:
        """Return the commanded drive force [N] and steering angle [rad], (2,)."""
        return control(state, reference, self.vehicle, self.gains)

    def shapes(self) -> list[Shape]:
        """Return the only part for drawing: the body as a box, with its wheels."""
        vehicle = self.vehicle
        low, high = -vehicle.rear_overhang, vehicle.length - vehicle.rear_overhang
        half = 0.5 * vehicle.width
        ring = np.array([(low, -half), (high, -half), (high, half), (low, half), (low, -half)])
        bottom, top = (
            np.pad(ring, ((0, 0), (0, 1)), constant_values=z)
            for z in (_CLEARANCE, _CLEARANCE + _HEIGHT)
        )
        corners = [np.stack([bottom[k], top[k]]) for k in range(4)]
        turn = np.linspace(0.0, 2.0 * np.pi, 17)
        rim = vehicle.wheel_radius * np.stack([np.cos(turn), 0.0 * turn, np.sin(turn)], axis=1)
        wheels = [place + rim for place in self._wheels()]
        return [Shape([*wheels, *corners, bottom, top], [], tool=True)]

    def places(self, pose: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return position [m] and quaternion w x y z of the only drawn shape at a pose (3,)."""
        half = 0.5 * pose[2]
        return [
            (np.append(pose[:2], 0.0), np.array([np.cos(half), 0.0, 0.0, np.sin(half)])),
        ]

    def place(self, poses: np.ndarray) -> np.ndarray:
        """Return the points (..., 3) [m] on the ground below the rear axle, at poses (..., 3)."""
        return np.concatenate([poses[..., :2], 0.0 * poses[..., :1]], axis=-1)

    def find_held_ball(self, pose: np.ndarray) -> np.ndarray:
        """Return NaN (3,), since the car holds no ball."""
        return np.full(3, np.nan)
