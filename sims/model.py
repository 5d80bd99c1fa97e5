# Pyright cannot see the names of MuJoCo's compiled module.
# pyright: reportAttributeAccessIssue=false
"""The simulated world: MJCF of a robot, balls and ground, for MuJoCo and for MJX.

Positions are in the world frame, z up, in SI units. `qpos` holds the robot's joint positions and
then the balls' positions, `qvel` the robot's joint velocities and then the balls' velocities. A
ball does not spin [Yu2023bat, Section II], so that its joint consists of three slide joints. Ball
drag is a force in MuJoCo's array `qfrc_applied`.

The model has no contacts. The racket's impact is computed by a function of the library, and a ball
counts as caught when it has crossed the hoop's disc (`scoring`). Scenery and pitching machine are
visual only: they touch nothing and cost no computing time.

MuJoCo's Euler integrator is semi-implicit: its stored velocity belongs to half a step before the
position. `place_balls` and `ball_velocity` correct for this half step, so that a ball's flight is
integrated with second order.
"""

import contextlib
import dataclasses
import functools
import io
from typing import cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.missing_extra import MissingExtra

with contextlib.redirect_stdout(io.StringIO()):  # hides the message that Warp is not installed
    try:
        from mujoco import mjx
    except ModuleNotFoundError as error:  # a package that MJX imports, such as trimesh
        raise MissingExtra("a flight", error.name, "sims") from None

from planner_jax.ball.flight import BallState, ball_acceleration
from planner_jax.sims.robot import Physics, Robot, ToolRobot
from planner_jax.sims.scenery import (
    GROUND_COLOUR,
    VISUAL,
    Part,
    machine_parts,
    part_xml,
    xml_colour,
    xml_numbers,
)

BALL_RADIUS, BALL_MASS = 0.02, 0.0027  # [m], [kg]: a table tennis ball
_TOWARDS_NET = np.pi  # [rad], heading of a pitching machine that throws along -x


@dataclasses.dataclass(frozen=True)
class World:
    """The settings of the simulated world: robot, balls and scenery; static under `jax.jit`."""

    robot: Robot
    gravity: float  # [m/s^2], magnitude
    num_balls: int = 1
    timestep: float = 0.002  # [s]
    scenery: tuple[Part, ...] = ()  # visual parts of the surroundings
    mouth: tuple[float, float, float] | None = None  # [m], where balls leave the pitching machine
    floats: bool = False  # whether balls have no weight, and without drag a constant velocity

    def __post_init__(self) -> None:
        if self.num_balls < 0:
            raise ArgumentError("num_balls", ">= 0", self.num_balls)
        if not self.timestep > 0.0:
            raise ArgumentError("timestep", "> 0", self.timestep)

    @property
    def carrier(self) -> ToolRobot:
        """The robot, typed as a robot that carries a tool.

        Raises:
            TypeError: the robot carries no tool.
        """
        if not hasattr(self.robot, "tool"):
            raise ArgumentTypeError(
                "robot", "a tool", verb="carry", shown=f"a {type(self.robot).__name__}"
            )
        return cast(ToolRobot, self.robot)


def mjcf(world: World) -> str:
    """Return the model of a world as text in MJCF, MuJoCo's model format."""
    body, actuators = world.robot.mjcf()
    machine = machine_parts(world.mouth, _TOWARDS_NET) if world.mouth else []
    slides = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    inertia = 0.4 * BALL_MASS * BALL_RADIUS**2
    balls = "".join(
        f'<body name="ball{k}">{slides}'
        f'<inertial pos="0 0 0" mass="{BALL_MASS}" diaginertia="{xml_numbers(*[inertia] * 3)}"/>'
        f'<geom name="ball{k}" type="sphere" size="{BALL_RADIUS}" rgba="1 .5 0 1" {VISUAL}/></body>'
        for k in range(world.num_balls)
    )
    return f"""
<mujoco model="flight">
  <option timestep="{world.timestep}" gravity="0 0 {-world.gravity}" integrator="Euler"
          iterations="1" ls_iterations="4">
    <flag eulerdamp="disable" constraint="disable" contact="disable"/>
  </option>
  <visual>
    <quality shadowsize="1024"/><headlight ambient=".4 .4 .4" diffuse=".3 .3 .3"/>
  </visual>
  <worldbody>
    <light directional="true" dir="0 .3 -1" diffuse=".5 .5 .5" castshadow="false"/>
    <geom name="ground" type="plane" size="10 10 .1" rgba="{xml_colour(GROUND_COLOUR)}" {VISUAL}/>
    {"".join(map(part_xml, (*machine, *world.scenery)))}
    {body}
    {balls}
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>"""


@functools.cache
def mujoco_model(world: World) -> mujoco.MjModel:
    """Return the compiled model of a world for plain MuJoCo."""
    return mujoco.MjModel.from_xml_string(mjcf(world))


@functools.cache
def _mjx_model(world: World) -> tuple[mjx.Model, mjx.Data]:
    """Return the model for MJX's JAX implementation, and MJX data as a template for states.

    Leaves are NumPy arrays, so that cached values belong to no JAX trace.
    """
    model = mujoco_model(world)
    with jax.ensure_compile_time_eval():
        device_model = mjx.put_model(model, impl="jax")
        data = mjx.make_data(device_model, impl="jax")
    return device_model, data


def step(world: World, physics: Physics, command: Array, drag: Array) -> Physics:
    """Simulate one time step of one world in MJX; pure, so that it can be scanned and batched.

    Args:
        world: settings of the model.
        physics: state before the step.
        command: (A,), command for the robot's A actuators.
        drag: (N,), drag coefficients K_D [1/m] of the N balls.
    """
    model, data = _mjx_model(world)
    controls, forces = world.robot.drive(physics, command, world.timestep)
    on_balls = _ball_forces(world, physics.qvel[world.robot.num_vel :], drag)
    data = data.replace(
        qpos=physics.qpos,
        qvel=physics.qvel,
        act=physics.act,
        ctrl=controls,
        qfrc_applied=jnp.concatenate([forces, on_balls]),
    )
    # MJX combines arrays of different ranks, which this library's tests forbid in other code.
    with jax.numpy_rank_promotion("allow"):
        data = mjx.step(model, data)
    return Physics(qpos=data.qpos, qvel=data.qvel, act=data.act)


def _ball_forces(world: World, qvel: Array, drag: Array) -> Array:
    """Return the drag  -m K_D |v| v  [N] of N balls of mass m and velocity v, as (3 N,).

    A lift that balances the weight is added if the balls float.
    """
    vel = qvel.reshape(world.num_balls, 3)
    speed = jnp.sqrt(jnp.sum(vel**2, axis=1, keepdims=True))
    forces = -BALL_MASS * drag[:, None] * speed * vel
    return (forces.at[:, 2].add(BALL_MASS * world.gravity) if world.floats else forces).ravel()


def at_rest(world: World, place: Array) -> Physics:
    """Return the state of a world: robot at standstill at `place` (3,) [m], balls 100 m away.

    Several robots stand still at `place` (N, 3).
    """
    place = jnp.asarray(place)
    qpos, qvel, act = world.robot.at_rest(place, world.gravity)
    away = jnp.tile(jnp.array([100.0, 0.0, 0.0], place.dtype), world.num_balls)
    return Physics(
        qpos=jnp.concatenate([qpos, away]),
        qvel=jnp.concatenate([qvel, jnp.zeros(3 * world.num_balls, place.dtype)]),
        act=act,
    )


def place_balls(
    world: World, physics: Physics, balls: BallState, drag: Array, which: Array
) -> Physics:
    """Return the state of one world after some balls have been set to new states.

    Args:
        world: settings of the model.
        physics: state of one world.
        balls: new states of the N balls, leaves (N, 3).
        drag: (N,), drag coefficients K_D [1/m].
        which: (N,) bool, the balls to set; other balls do not change.
    """
    acc = _ball_accelerations(world, balls.vel, drag)
    pos, vel = ball_states(world, physics)
    pos = jnp.where(which[:, None], balls.pos, pos)
    vel = jnp.where(which[:, None], balls.vel - 0.5 * world.timestep * acc, vel)
    return dataclasses.replace(
        physics,
        qpos=physics.qpos.at[world.robot.num_pos :].set(pos.ravel()),
        qvel=physics.qvel.at[world.robot.num_vel :].set(vel.ravel()),
    )


def ball_states(world: World, physics: Physics) -> tuple[Array, Array]:
    """Return the positions [m] and MuJoCo's stored velocities [m/s] of N balls, (N, 3) each."""
    pos, vel = physics.qpos[world.robot.num_pos :], physics.qvel[world.robot.num_vel :]
    return pos.reshape(world.num_balls, 3), vel.reshape(world.num_balls, 3)


def ball_velocity(world: World, vel: Array, drag: Array) -> Array:
    """Return the velocities (N, 3) [m/s] of N balls at the time of their positions.

    MuJoCo's stored velocities `vel` belong to half a step earlier; `drag` (N,) [1/m] is K_D.
    """
    return vel + 0.5 * world.timestep * _ball_accelerations(world, vel, drag)


def _ball_accelerations(world: World, vel: Array, drag: Array) -> Array:
    gravity = jnp.asarray(0.0 if world.floats else world.gravity, vel.dtype)
    return jax.vmap(ball_acceleration, in_axes=(0, 0, None))(vel, drag, gravity)
