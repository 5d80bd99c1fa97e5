"""What the simulated world, the closed loop and the pictures ask of a robot.

A robot is a frozen dataclass, static under jit: `robots/quadrotor/robot.py` is one, which carries a
tool, `robots/car/robot.py` and `robots/arm/robot.py` are two without. Its part of MuJoCo's state
comes first in `qpos` and `qvel`, before that of the balls; all of `act` is its own.
"""

from typing import Any, ClassVar, NamedTuple, Protocol

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.robot.quadrotor_model import QuadrotorModel, Tool


@struct.dataclass
class Physics:
    """What changes from step to step, for R joint positions of the robot and N balls."""

    qpos: Array  # (R + 3 N,)
    qvel: Array  # (R' + 3 N,)
    act: Array  # (A,), what the actuators have reached, in their units


class Solid(NamedTuple):
    """The surface of a body, closed and convex."""

    corners: np.ndarray  # (V, 3) [m]
    triangles: np.ndarray  # (T, 3) int, seen from outside counter-clockwise


class Shape(NamedTuple):
    """A rigid part of a robot as it is drawn, in the part's own frame."""

    lines: list[np.ndarray]  # each (M, 3) [m]
    discs: list[tuple[np.ndarray, float]]  # centre (3,) [m] and radius [m], across the z axis
    tool: bool = False  # whether the last line is the tool's rim
    solids: tuple[Solid, ...] = ()
    colour: str = "#D9A441"  # of the solids


def rotation(quat_wxyz: Any, array_library: Any = jnp) -> Any:
    """Rotation matrix (3, 3), body to world, of a unit quaternion (4,).

    Args:
        quat_wxyz: w x y z.
        array_library: `jax.numpy`, or `numpy` for a result in the precision of the host.
    """
    w, x, y, z = quat_wxyz
    return array_library.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


class Robot(Protocol):
    """A robot's part of a flight. `World` is `sims.model.World`, which holds the robot."""

    WORDS: ClassVar[str]  # how it is simulated and controlled, for the page of a run
    num_pos: ClassVar[int]  # R, of its joint positions in `qpos`
    num_vel: ClassVar[int]  # R', of its joint velocities in `qvel`
    noise_shape: ClassVar[tuple[int, ...]]  # of the standard normal noise that `sense` takes

    def mjcf(self) -> tuple[str, str]:
        """Its body and its actuators as MJCF text."""
        ...

    def at_rest(self, place: Array, gravity: float) -> tuple[Array, Array, Array]:
        """Its part of `qpos` and `qvel`, and `act`, at rest at a place (3,) [m]."""
        ...

    def drive(self, physics: Physics, command: Array, timestep: float) -> tuple[Array, Array]:
        """What a command (A,) makes of its controls (A,), and forces on its joints (R',).

        The forces are those that no actuator of the model has, such as those of tyres.
        """
        ...

    def state(self, physics: Physics) -> Any:
        """Its state, a pytree."""
        ...

    def sense(self, state: Any, noise: Array, stds: Any) -> Any:
        """Its state as it is estimated, with errors of some standard deviations."""
        ...

    def references(self, plan: Any, times: Array, world: Any) -> Any:
        """What it tracks (K,) [s] after a plan's begin, leaves (K, ...); `pos` is the place."""
        ...

    def command(self, state: Any, reference: Any, world: Any) -> Array:
        """What is asked of the actuators (A,) to track one reference."""
        ...

    def shapes(self) -> list[Shape]:
        """Its rigid parts as they are drawn."""
        ...

    def places(self, pose: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Position (3,) [m] and attitude (4,), w x y z, of each shape at joint positions (R,)."""
        ...

    def place(self, poses: np.ndarray) -> np.ndarray:
        """The point (..., 3) [m] that stands for the robot at joint positions (..., R)."""
        ...

    def find_held_ball(self, pose: np.ndarray) -> np.ndarray:
        """Centre (3,) [m] of a ball that lies in the tool; NaN if the tool holds none."""
        ...


class ToolRobot(Robot, Protocol):
    """A robot that meets balls with a tool."""

    @property
    def model(self) -> QuadrotorModel:
        """What plans are made for."""
        ...

    @property
    def tool(self) -> Tool:
        """What it meets balls with."""
        ...

    def tool_motion(self, state: Any) -> tuple[Array, Array, Array, Array]:
        """Of the body with the tool, in the world: place, velocity, rate and z axis, (3,) each."""
        ...

    def head_state(self, plan: Any, time: Array) -> Array:
        """Its state () [s] after a plan's begin, from where another begins; first row the place."""
        ...
