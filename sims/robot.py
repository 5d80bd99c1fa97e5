"""The protocol of a robot, by which the simulated world, the closed loop and pictures use it.

A robot is a frozen dataclass, static under `jax.jit`. The quadrotor in `robots/quadrotor/robot.py`
carries a tool; the car and the arm in `robots/car/robot.py` and `robots/arm/robot.py` do not. The
robot's part of MuJoCo's state comes first in `qpos` and `qvel`, before the balls. All of `act`
belongs to the robot.
"""

from typing import Any, ClassVar, NamedTuple, Protocol

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from planner_jax.robot.quadrotor_model import QuadrotorModel, Tool


@struct.dataclass
class Physics:
    """The part of MuJoCo's state that changes from step to step.

    The robot has R joint positions and R' joint velocities; there are N balls and A actuators.
    """

    qpos: Array  # (R + 3 N,), joint positions of robot and balls
    qvel: Array  # (R' + 3 N,), joint velocities of robot and balls
    act: Array  # (A,), states of the actuators, in their units


class Solid(NamedTuple):
    """The surface of a closed convex body, as a mesh of triangles."""

    corners: np.ndarray  # (V, 3) [m], positions of the V corners
    triangles: np.ndarray  # (T, 3) int, corner indices, counter-clockwise when seen from outside


class Shape(NamedTuple):
    """A rigid part of a robot for drawing, in the part's own frame."""

    lines: list[np.ndarray]  # polygonal lines with M points, each (M, 3) [m]
    discs: list[tuple[np.ndarray, float]]  # centre (3,) [m] and radius [m], normal to the z axis
    tool: bool = False  # whether the last line is the tool's rim
    solids: tuple[Solid, ...] = ()
    colour: str = "#D9A441"  # colour of the solids


def rotation(quat_wxyz: Any, array_library: Any = jnp) -> Any:
    """Return the rotation matrix (3, 3), body to world, of a unit quaternion (4,).

    Args:
        quat_wxyz: the quaternion, w x y z.
        array_library: `jax.numpy`, or `numpy` for a result in float64.
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
    """The protocol of a simulated robot; `world` is the `sims.model.World` that holds it."""

    WORDS: ClassVar[str]  # description of simulation and control, for the report of a run

    @property
    def num_pos(self) -> int:
        """R, the number of the robot's joint positions in `qpos`."""
        ...

    @property
    def num_vel(self) -> int:
        """R', the number of the robot's joint velocities in `qvel`."""
        ...

    @property
    def noise_shape(self) -> tuple[int, ...]:
        """Shape of the standard normal noise that `sense` uses."""
        ...

    def mjcf(self) -> tuple[str, str]:
        """Return two texts in MJCF, MuJoCo's model format: the robot's body, and its actuators."""
        ...

    def at_rest(self, place: Array, gravity: float) -> tuple[Array, Array, Array]:
        """Return MuJoCo's `qpos`, `qvel` and `act` of the robot at rest at a position (3,) [m]."""
        ...

    def drive(self, physics: Physics, command: Array, timestep: float) -> tuple[Array, Array]:
        """Convert a command to MuJoCo's controls (A,) and to extra generalised forces (R',).

        R' is the number of the robot's joint velocities. The extra forces, such as tyre forces,
        have no actuators in the model. `timestep` is MuJoCo's time step [s].
        """
        ...

    def state(self, physics: Physics) -> Any:
        """Return the robot's true state, a pytree, from the simulated physics."""
        ...

    def sense(self, state: Any, noise: Array, stds: Any) -> Any:
        """Return the state plus errors: normal `noise` times the standard deviations `stds`."""
        ...

    def references(self, plan: Any, times: Array, world: Any) -> Any:
        """Return the planned states to track at K times (K,) [s] since a plan's start.

        In every array of the result the first axis is K. One of its fields is the position `pos`.
        """
        ...

    def command(self, state: Any, reference: Any, world: Any) -> Array:
        """Return the command for the A actuators that tracks one planned state, the reference."""
        ...

    def shapes(self) -> list[Shape]:
        """Return the robot's rigid parts for drawing."""
        ...

    def places(self, pose: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return position (3,) [m] and quaternion w x y z of each shape at R joint positions."""
        ...

    def place(self, poses: np.ndarray) -> np.ndarray:
        """Return the robot's position, a point (..., 3) [m], at R joint positions (..., R).

        For N robots in one world the result is (..., 3 N).
        """
        ...

    def find_held_ball(self, pose: np.ndarray) -> np.ndarray:
        """Return the centre (3,) [m] of a ball in the tool; NaN if the tool holds none."""
        ...


class ToolRobot(Robot, Protocol):
    """The protocol of a robot that hits or catches balls with a tool."""

    @property
    def model(self) -> QuadrotorModel:
        """The model of the quadrotor for which plans are made."""
        ...

    @property
    def wind(self) -> tuple[float, ...]:
        """The velocity of the air, (3,) [m/s]; plans know it if the model has drag."""
        ...

    @property
    def tool(self) -> Tool:
        """The tool that hits or catches balls."""
        ...

    def tool_motion(self, state: Any) -> tuple[Array, Array, Array, Array]:
        """Return position, velocity, angular rate and z axis of the body that carries the tool.

        Each is (3,), in the world frame.
        """
        ...

    def head_state(self, plan: Any, time: Array) -> Array:
        """Return the robot's planned state at a time () [s] since the start of a plan.

        Its rows are position, velocity and higher derivatives, (4, 3) for a quadrotor.
        """
        ...
