"""Several simulated quadrotors of one kind in one world, as one `sims.robot.Robot`.

States, references, plans and noise have a leading axis N, the number of quadrotors. MuJoCo's arrays
hold the numbers of one quadrotor after the other. `sims.robot` explains the methods.
"""

import dataclasses
import functools
from typing import Any, ClassVar

import jax
import numpy as np
from jax import Array

from planner_jax.robot.quadrotor_model import Tool
from planner_jax.sims.model import World
from planner_jax.sims.robot import Physics, Shape
from planner_jax.sims.robots.quadrotor.control import RobotState
from planner_jax.sims.robots.quadrotor.reference import Reference
from planner_jax.sims.robots.quadrotor.robot import Quadrotor


@dataclasses.dataclass(frozen=True)
class Squad:
    """N simulated quadrotors with the same tool; static under `jax.jit`."""

    member: Quadrotor
    number: int  # N

    WORDS: ClassVar[str] = f"several quadrotors in one world: {Quadrotor.WORDS}"

    @property
    def num_pos(self) -> int:
        """The number of all joint positions in `qpos`."""
        return self.number * self.member.num_pos

    @property
    def num_vel(self) -> int:
        """The number of all joint velocities in `qvel`."""
        return self.number * self.member.num_vel

    @property
    def noise_shape(self) -> tuple[int, ...]:
        """Shape of the standard normal noise that `sense` uses."""
        return self.number, *self.member.noise_shape

    @property
    def tool(self) -> Tool:
        """The racket or net that every quadrotor carries."""
        return self.member.tool

    def mjcf(self) -> tuple[str, str]:
        """Return two texts in MJCF: all bodies, and all motors."""
        bodies, motors = zip(*(self.member.mjcf(f"{k}") for k in range(self.number)), strict=True)
        return "".join(bodies), "".join(motors)

    def at_rest(self, place: Array, gravity: float) -> tuple[Array, Array, Array]:
        """Return `qpos`, `qvel` and `act` of N quadrotors that hover at positions (N, 3) [m]."""
        parts = jax.vmap(functools.partial(self.member.at_rest, gravity=gravity))(place)
        return parts[0].ravel(), parts[1].ravel(), parts[2].ravel()

    def _split(self, physics: Physics) -> Physics:
        """Return the part of each quadrotor, leaves (N, ...), without the balls."""
        pos, vel = physics.qpos[: self.num_pos], physics.qvel[: self.num_vel]
        return Physics(*(leaf.reshape(self.number, -1) for leaf in (pos, vel, physics.act)))

    def drive(self, physics: Physics, command: Array, timestep: float) -> tuple[Array, Array]:
        """Return the rotor thrusts [N] unchanged, and the quadrotors' drag as extra forces."""
        drive = functools.partial(self.member.drive, timestep=timestep)
        controls, forces = jax.vmap(drive)(self._split(physics), command.reshape(self.number, -1))
        return controls.ravel(), forces.ravel()

    def state(self, physics: Physics) -> RobotState:
        """Return the true states of the quadrotors from the simulated physics."""
        return jax.vmap(self.member.state)(self._split(physics))

    def sense(self, state: RobotState, noise: Array, stds: tuple[float, ...]) -> RobotState:
        """Return the estimated states: the true states plus errors."""
        return jax.vmap(functools.partial(self.member.sense, stds=stds))(state, noise)

    def tool_motion(self, state: RobotState) -> tuple[Array, Array, Array, Array]:
        """Return position, velocity, rate and z axis of the N bodies, each (N, 3)."""
        return jax.vmap(self.member.tool_motion)(state)

    def head_state(self, plan: Any, time: Array) -> Array:
        """Return the planned states (4, N, 3) of the quadrotors at a time () [s]."""
        return jax.vmap(self.member.head_state, (0, None), 1)(plan, time)

    def references(self, plan: Any, times: Array, world: World) -> Reference:
        """Return the references at K times [s] since the start of the plans, leaves (K, N, ...)."""
        one = functools.partial(self.member.references, times=times, world=world)
        return jax.vmap(one, out_axes=1)(plan)

    def command(self, state: RobotState, reference: Reference, world: World) -> Array:
        """Return the rotor thrusts (4 N,) [N] with which each quadrotor tracks its reference."""
        return jax.vmap(functools.partial(self.member.command, world=world))(
            state, reference
        ).ravel()

    def shapes(self) -> list[Shape]:
        """Return the parts of all quadrotors for drawing."""
        return self.number * self.member.shapes()

    def places(self, pose: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return position [m] and quaternion w x y z of each shape at a pose (7 N,)."""
        return [each for own in np.split(pose, self.number) for each in self.member.places(own)]

    def place(self, poses: np.ndarray) -> np.ndarray:
        """Return the positions (..., 3 N) [m] of the quadrotors at joint positions (..., 7 N)."""
        own = poses.reshape(*poses.shape[:-1], self.number, -1)
        return self.member.place(own).reshape(*poses.shape[:-1], -1)

    def find_held_ball(self, pose: np.ndarray) -> np.ndarray:
        """Return NaN (3,), as joint positions do not tell which quadrotor holds a ball."""
        return np.full(3, np.nan)
