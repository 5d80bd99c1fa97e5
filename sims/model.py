# MuJoCo's names come from a compiled module.
# pyright: reportAttributeAccessIssue=false
"""The simulated world: MJCF of quadrotor, tool, balls and ground, for MuJoCo and for MJX.

World frame, z up, SI units. `qpos` holds the quadrotor's position and quaternion (w x y z) and
then the balls' positions; `qvel` its velocity (world), body rate (body frame) and then the
balls' velocities. A ball does not spin (paper 002, Section II), so three slides are its joint.
Rotors are MuJoCo actuators with a first-order lag; ball drag is a force in `qfrc_applied`.

In flight nothing touches: the racket's impact is the library's map and a caught ball has
crossed the hoop's disc (`scoring`), so the batch model has no contacts. The model with contacts
is for comparison with MuJoCo's own. Court and pitching machine are there to be looked at: they
touch nothing and cost no step anything.

MuJoCo's Euler is semi-implicit: the velocity it keeps lies half a step before the position. For
a ball that is taken care of at both ends, by `placed` and `ball_velocity`, which makes its
flight second order.
"""

import contextlib
import dataclasses
import functools
import io

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax import Array

with contextlib.redirect_stdout(io.StringIO()):  # it prints that Warp, not needed here, is missing
    from mujoco import mjx

from planner_jax.ball.flight import BallState, ball_acceleration
from planner_jax.sims.scenery import (
    GROUND_COLOUR,
    MOUTHS,
    TOWARDS_NET,
    Part,
    court_parts,
    machine_parts,
)
from planner_jax.sims.vehicle import Vehicle, rotor_positions, rotor_torques

BALL_RADIUS, BALL_MASS = 0.02, 0.0027  # [m], [kg]: a table tennis ball
_LOOK = 'mass="0" contype="0" conaffinity="0"'  # of what is there to be looked at
_SEGMENTS = 12  # capsules of the hoop


@dataclasses.dataclass(frozen=True)
class Tool:
    """What meets the ball, on the body z axis: a disc that is the net's hoop or the racket."""

    kind: str  # "net" or "racket"
    height: float  # [m], of the disc's centre above the propeller plane
    radius: float  # [m]

    def __post_init__(self) -> None:
        if self.kind not in ("net", "racket"):
            raise ValueError(f"kind must be net or racket, got {self.kind!r}")


NET = Tool("net", height=0.2, radius=0.125)  # paper 000, Fig. 6
RACKET = Tool("racket", height=0.06, radius=0.11)  # paper 002, Fig. 2


@dataclasses.dataclass(frozen=True)
class World:
    """Everything that shapes the simulated model; static under jit."""

    tool: Tool
    num_balls: int = 1
    timestep: float = 0.002  # [s]
    gravity: float = 9.81  # [m/s^2], magnitude
    contacts: bool = False  # of the balls with ground and tool
    vehicle: Vehicle = Vehicle()

    def __post_init__(self) -> None:
        if self.num_balls < 1:
            raise ValueError(f"num_balls must be >= 1, got {self.num_balls}")
        if not self.timestep > 0.0:
            raise ValueError(f"timestep must be > 0, got {self.timestep}")


@struct.dataclass
class Physics:
    """What changes from step to step; the rest of MuJoCo's data follows from it."""

    qpos: Array  # (7 + 3 N,)
    qvel: Array  # (6 + 3 N,)
    act: Array  # (4,) [N], thrusts that the rotors have reached


def _text(*values: float) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _tool_xml(world: World) -> str:
    """The hoop as a ring of capsules over a plate, or the racket as a plate."""
    tool = world.tool
    side = 0.5 * np.sqrt(np.pi) * tool.radius  # of the square of the disc's area, halved
    drop = 0.0 if tool.kind == "racket" else 2.0 * BALL_RADIUS
    plate = (
        f'<geom name="plate" type="box" size="{_text(side, side, 0.002)}" '
        f'pos="0 0 {_text(tool.height - drop - 0.002 - BALL_RADIUS)}" rgba=".3 .5 .9 .5" {_LOOK}/>'
    )
    if tool.kind == "racket":
        return plate
    turn = 2.0 * np.pi * np.arange(_SEGMENTS + 1) / _SEGMENTS
    rim = np.stack([np.cos(turn), np.sin(turn)], axis=1) * tool.radius
    ring = "".join(
        f'<geom type="capsule" size=".004" rgba=".2 .2 .2 1" {_LOOK} '
        f'fromto="{_text(*a, tool.height, *b, tool.height)}"/>'
        for a, b in zip(rim[:-1], rim[1:], strict=True)
    )
    return plate + ring


def _scenery_xml(world: World) -> str:
    """The pitching machine, and for hits the court."""
    kind = world.tool.kind
    parts = machine_parts(MOUTHS[kind], TOWARDS_NET) + (court_parts() if kind == "racket" else [])
    return "".join(map(_part_xml, parts))


def _part_xml(part: Part) -> str:
    length, width, height = (0.5 * size for size in part.size)
    half = (length, width, height) if part.kind == "box" else (length, height)
    return (
        f'<geom type="{part.kind}" size="{_text(*half)}" pos="{_text(*part.centre)}" '
        f'quat="{_text(*part.quat_wxyz)}" rgba="{_rgba(part.colour)}" {_LOOK}/>'
    )


def _rgba(colour: str) -> str:
    """Of #RRGGBB."""
    return _text(*(int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)), 1.0)


def _contact_xml(world: World) -> str:
    """A spring as stiff as the time step bears; damped so that a net holds and a racket bounces.

    The racket's damping ratio gives a restitution of 0.7, exp(-pi r / sqrt(1 - r^2)).
    """
    rate = 0.5 / world.timestep
    ratio = 1.0 if world.tool.kind == "net" else 0.113
    return f'solref="{_text(-(rate**2), -2.0 * ratio * rate)}" solimp=".99 .99 .001"'


def mjcf(world: World) -> str:
    """The model as MJCF text.

    The plate is thin and a box, the one shape against which MJX bounces a sphere as MuJoCo
    does; its face lies a ball's radius below the disc, so that a centred ball touches it where
    its centre passes the disc (for the net, one ball's diameter later).
    """
    vehicle = world.vehicle
    places = rotor_positions(vehicle)
    rotors = "".join(
        f'<site name="rotor{i}" pos="{_text(*place)}"/>'
        f'<geom type="cylinder" size=".06 .003" pos="{_text(*place)}" rgba=".2 .2 .2 .6" {_LOOK}/>'
        f'<geom type="capsule" size=".008" fromto="0 0 0 {_text(*place)}" {_LOOK}/>'
        for i, place in enumerate(places)
    )
    motors = "".join(
        f'<general site="rotor{i}" gear="0 0 1 0 0 {_text(torque)}" ctrllimited="true" '
        f'ctrlrange="0 {_text(vehicle.max_rotor_thrust)}" dyntype="filterexact" '
        f'dynprm="{_text(vehicle.rotor_lag)}"/>'
        for i, torque in enumerate(rotor_torques(vehicle))
    )
    slides = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    inertia = 0.4 * BALL_MASS * BALL_RADIUS**2
    balls = "".join(
        f'<body name="ball{k}">{slides}'
        f'<inertial pos="0 0 0" mass="{BALL_MASS}" diaginertia="{_text(*[inertia] * 3)}"/>'
        f'<geom name="ball{k}" type="sphere" size="{BALL_RADIUS}" rgba="1 .5 0 1" {_LOOK}/></body>'
        for k in range(world.num_balls)
    )
    pairs = "".join(
        f'<pair geom1="{other}" geom2="ball{k}" condim="1" {firm}/>'
        for k in range(world.num_balls)
        for other, firm in (("ground", ""), ("plate", _contact_xml(world)))
    )
    switch = "" if world.contacts else ' constraint="disable" contact="disable"'
    return f"""
<mujoco model="{world.tool.kind}">
  <option timestep="{world.timestep}" gravity="0 0 {-world.gravity}" integrator="Euler"
          iterations="1" ls_iterations="4">
    <flag eulerdamp="disable"{switch}/>
  </option>
  <visual>
    <quality shadowsize="1024"/><headlight ambient=".4 .4 .4" diffuse=".3 .3 .3"/>
  </visual>
  <worldbody>
    <light directional="true" dir="0 .3 -1" diffuse=".5 .5 .5" castshadow="false"/>
    <geom name="ground" type="plane" size="10 10 .1" rgba="{_rgba(GROUND_COLOUR)}" {_LOOK}/>
    {_scenery_xml(world)}
    <body name="quadrotor"><freejoint/>
      <inertial pos="0 0 0" mass="{vehicle.mass}" diaginertia="{_text(*vehicle.inertia)}"/>
      {rotors}{_tool_xml(world)}
    </body>
    {balls}
  </worldbody>
  <actuator>{motors}</actuator>
  {f"<contact>{pairs}</contact>" if world.contacts else ""}
</mujoco>"""


@functools.cache
def mujoco_model(world: World) -> mujoco.MjModel:
    """The model for plain MuJoCo."""
    return mujoco.MjModel.from_xml_string(mjcf(world))


@functools.cache
def _mjx_model(world: World) -> tuple[mjx.Model, mjx.Data]:
    """The model for MJX's JAX implementation, and data whose state is to be filled in.

    NumPy leaves, so that what is kept belongs to no trace.
    """
    model = mujoco_model(world)
    with jax.ensure_compile_time_eval():
        device_model = mjx.put_model(model, impl="jax")
        data = mjx.make_data(device_model, impl="jax")
    return device_model, data


def step(world: World, physics: Physics, rotors: Array, drag: Array) -> Physics:
    """One time step of one world in MJX; pure, so scan, vmap and jit it.

    Args:
        world: the model.
        physics: before the step.
        rotors: (4,) [N], thrusts asked of the rotors.
        drag: (N,) K_D [1/m] of the balls.
    """
    model, data = _mjx_model(world)
    data = data.replace(
        qpos=physics.qpos,
        qvel=physics.qvel,
        act=physics.act,
        ctrl=rotors,
        qfrc_applied=_drag_force(world, physics.qvel, drag),
    )
    data = mjx.step(model, data)
    return Physics(qpos=data.qpos, qvel=data.qvel, act=data.act)


def _drag_force(world: World, qvel: Array, drag: Array) -> Array:
    """Quadratic drag  -m K_D |v| v  of every ball as generalised forces (6 + 3 N,)."""
    vel = qvel[6:].reshape(world.num_balls, 3)
    speed = jnp.sqrt(jnp.sum(vel**2, axis=1, keepdims=True))
    return jnp.concatenate(
        [jnp.zeros_like(qvel[:6]), (-BALL_MASS * drag[:, None] * speed * vel).ravel()]
    )


def step_mujoco(world: World, data: mujoco.MjData, rotors: np.ndarray, drag: np.ndarray) -> None:
    """One time step in plain MuJoCo, as `step`; changes `data`."""
    vel = data.qvel[6:].reshape(world.num_balls, 3)
    speed = np.linalg.norm(vel, axis=1, keepdims=True)
    data.ctrl[:] = rotors
    data.qfrc_applied[6:] = (-BALL_MASS * np.asarray(drag)[:, None] * speed * vel).ravel()
    mujoco.mj_step(mujoco_model(world), data)


def mujoco_data(world: World, physics: Physics) -> mujoco.MjData:
    """Data of plain MuJoCo at a state."""
    data = mujoco.MjData(mujoco_model(world))
    data.qpos[:], data.qvel[:], data.act[:] = physics.qpos, physics.qvel, physics.act
    return data


def hovering(world: World, pos: Array) -> Physics:
    """A quadrotor in hover at (3,) [m] with its rotors at their speed; balls lie far off."""
    pos = jnp.asarray(pos)
    upright = jnp.array([1.0, 0.0, 0.0, 0.0], pos.dtype)
    away = jnp.tile(jnp.array([100.0, 0.0, 0.0], pos.dtype), world.num_balls)
    lift = world.vehicle.mass * world.gravity / 4.0
    return Physics(
        qpos=jnp.concatenate([pos, upright, away]),
        qvel=jnp.zeros(6 + 3 * world.num_balls, pos.dtype),
        act=jnp.full(4, lift, pos.dtype),
    )


def placed(world: World, physics: Physics, balls: BallState, drag: Array, which: Array) -> Physics:
    """The same with some balls in flight.

    Args:
        world: the model.
        physics: of one world.
        balls: leaves (N, 3).
        drag: (N,) K_D [1/m].
        which: (N,) bool, the balls to place; the others stay as they are.
    """
    acc = _ball_accelerations(world, balls.vel, drag)
    pos, vel = ball_states(world, physics)
    pos = jnp.where(which[:, None], balls.pos, pos)
    vel = jnp.where(which[:, None], balls.vel - 0.5 * world.timestep * acc, vel)
    return dataclasses.replace(
        physics,
        qpos=physics.qpos.at[7:].set(pos.ravel()),
        qvel=physics.qvel.at[6:].set(vel.ravel()),
    )


def ball_states(world: World, physics: Physics) -> tuple[Array, Array]:
    """Positions and kept velocities of the balls, (N, 3) each."""
    num = world.num_balls
    return physics.qpos[7:].reshape(num, 3), physics.qvel[6:].reshape(num, 3)


def ball_velocity(world: World, vel: Array, drag: Array) -> Array:
    """Velocities (N, 3) at the time of the positions, from the kept ones and K_D (N,)."""
    return vel + 0.5 * world.timestep * _ball_accelerations(world, vel, drag)


def _ball_accelerations(world: World, vel: Array, drag: Array) -> Array:
    gravity = jnp.asarray(world.gravity, vel.dtype)
    return jax.vmap(ball_acceleration, in_axes=(0, 0, None))(vel, drag, gravity)
