"""The simulated quadrotor, a `sims.robot.Robot` with a tool on the body z axis.

`qpos` starts with the position and the quaternion (w x y z), `qvel` with the velocity (world frame)
and the body rate (body frame). The rotors are MuJoCo actuators with a first-order lag.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.robot.attitude import tilt_quaternion
from planner_jax.robot.quadrotor import Air, add_drag, thrust_in_air
from planner_jax.robot.quadrotor_model import NET, RACKET, QuadrotorModel, RotorDrag, Tool
from planner_jax.sims.model import BALL_RADIUS, World
from planner_jax.sims.robot import Physics, Shape, rotation
from planner_jax.sims.robots.quadrotor.control import Gains, RobotState, control
from planner_jax.sims.robots.quadrotor.reference import Reference, reference_at, with_rest
from planner_jax.sims.scenery import VISUAL, xml_numbers
from planner_jax.trajectory.polynomial import evaluate, total_duration

_SEGMENTS = 12  # number of capsules of which the drawn hoop consists


@dataclasses.dataclass(frozen=True)
class Quadrotor:
    """The simulated quadrotor with a racket or a net; static under `jax.jit`."""

    model: QuadrotorModel  # as planner and controller know it
    gains: Gains = Gains()
    wind: tuple[float, ...] = (0.0, 0.0, 0.0)  # [m/s], velocity of the air; it acts by the drag
    drag: RotorDrag | None = None  # true drag of the rotors; None: the drag of `model`

    WORDS: ClassVar[str] = "rotors with lag, body-rate, attitude and position control"
    num_pos, num_vel, noise_shape = 7, 6, (4, 3)

    @property
    def tool(self) -> Tool:
        """The racket or net that hits or catches balls."""
        return self.model.tool

    def mjcf(self, name: str = "") -> tuple[str, str]:
        """Return two texts in MJCF, MuJoCo's format: the body with rotors and tool, and motors.

        All names in the texts end with `name`, which differs between robots of one world.
        """
        model, rotors = self.model, self.model.rotors
        discs = "".join(
            f'<site name="rotor{i}.{name}" pos="{xml_numbers(*place)}"/>'
            f'<geom type="cylinder" size="{rotors.radius:g} .003" '
            f'pos="{xml_numbers(*place)}" rgba=".2 .2 .2 .6" {VISUAL}/>'
            f'<geom type="capsule" size=".008" fromto="0 0 0 {xml_numbers(*place)}" {VISUAL}/>'
            for i, place in enumerate(rotors.positions)
        )
        motors = "".join(
            f'<general site="rotor{i}.{name}" gear="0 0 1 0 0 {xml_numbers(torque)}" '
            f'ctrllimited="true" ctrlrange="{xml_numbers(rotors.min_thrust, rotors.max_thrust)}" '
            f'dyntype="filterexact" dynprm="{xml_numbers(rotors.lag)}"/>'
            for i, torque in enumerate(rotors.torque_arms)
        )
        inertia = "diaginertia" if len(model.inertia) == 3 else "fullinertia"
        body = (
            f'<body name="quadrotor{name}"><freejoint/><inertial pos="0 0 0" '
            f'mass="{model.mass}" {inertia}="{xml_numbers(*model.inertia)}"/>'
            f"{discs}{self._tool_xml()}</body>"
        )
        return body, motors

    @property
    def air(self) -> Air | None:
        """The true drag and wind; None if there is no drag."""
        drag = self.drag or self.model.drag
        if drag is None:
            return None
        numbers = (drag.across, drag.along, self.wind)
        across, along, wind = (jnp.asarray(each, jnp.float32) for each in numbers)
        return Air(across, along, wind)

    def _tool_xml(self) -> str:
        """Return MJCF of the hoop as a ring of capsules over a plate, or of the racket's plate."""
        tool = self.tool
        low = tool.height - BALL_RADIUS * (1.0 if tool.kind == RACKET else 3.0)
        plate = (
            f'<geom type="cylinder" size="{xml_numbers(tool.radius)} .002" '
            f'pos="0 0 {xml_numbers(low)}" rgba=".3 .5 .9 .5" {VISUAL}/>'
        )
        if tool.kind == RACKET:
            return plate
        rim = _circle(np.array([0.0, 0.0, tool.height]), tool.radius, _SEGMENTS)
        ring = "".join(
            f'<geom type="capsule" size=".004" rgba=".2 .2 .2 1" {VISUAL} '
            f'fromto="{xml_numbers(*a, *b)}"/>'
            for a, b in zip(rim[:-1], rim[1:], strict=True)
        )
        return plate + ring

    def at_rest(self, place: Array, gravity: float) -> tuple[Array, Array, Array]:
        """Return `qpos`, `qvel` and `act` (rotor thrusts) of a hover at `place` (3,) [m]."""
        attitude, thrust = jnp.array([1.0, 0.0, 0.0, 0.0], place.dtype), gravity
        if (air := self.air) is not None:
            still, pull = jnp.zeros_like(place), jnp.asarray(gravity, place.dtype)
            load = add_drag(air, still, still)
            attitude = tilt_quaternion(load, pull)
            thrust = thrust_in_air(air, still, load, pull)
        lift = self.model.mass * thrust * self.model.rotors.shares
        return (
            jnp.concatenate([place, attitude]),
            jnp.zeros(self.num_vel, place.dtype),
            jnp.asarray(lift, place.dtype),
        )

    def drive(self, physics: Physics, command: Array, timestep: float) -> tuple[Array, Array]:
        """Return the command unchanged, as rotor thrusts (R,) [N], and the drag as extra forces."""
        forces = jnp.zeros(self.num_vel, command.dtype)
        if (air := self.air) is not None:
            axis, vel = rotation(physics.qpos[3:7])[:, 2], physics.qvel[:3] - air.wind
            along = (air.thrust_drag - air.drag) * jnp.sum(vel * axis) * axis
            forces = forces.at[:3].set(-self.model.mass * (air.drag * vel + along))
        return command, forces

    def state(self, physics: Physics) -> RobotState:
        """Return the true state of the quadrotor from the simulated physics."""
        qpos, qvel = physics.qpos, physics.qvel
        return RobotState(pos=qpos[:3], vel=qvel[:3], quat_wxyz=qpos[3:7], rate=qvel[3:6])

    def sense(self, state: RobotState, noise: Array, stds: tuple[float, ...]) -> RobotState:
        """Return the quadrotor's estimated state: the true state plus random errors.

        Args:
            state: the true state.
            noise: (4, 3) standard normal.
            stds: standard deviations of position [m], velocity [m/s], attitude [rad] and body rate
                [rad/s].
        """
        pos, vel, attitude, rate = (std * noise[k] for k, std in enumerate(stds))
        w, v = state.quat_wxyz[0], state.quat_wxyz[1:]
        half = 0.5 * attitude  # a small rotation in the body frame
        turned = jnp.concatenate([(w - jnp.sum(v * half))[None], v + w * half + jnp.cross(v, half)])
        return RobotState(
            pos=state.pos + pos,
            vel=state.vel + vel,
            quat_wxyz=turned / jnp.sqrt(jnp.sum(turned**2)),
            rate=state.rate + rate,
        )

    def tool_motion(self, state: RobotState) -> tuple[Array, Array, Array, Array]:
        """Return the body's position [m], velocity [m/s], rate [rad/s] and z axis, in the world."""
        R = rotation(state.quat_wxyz)
        return state.pos, state.vel, jnp.sum(R * state.rate[None], axis=1), R[:, 2]

    def head_state(self, plan: Any, time: Array) -> Array:
        """Return planned position, velocity, acceleration and jerk (4, 3) at a time () [s].

        Times count from the start of the plan. After the plan's end the quadrotor brakes, and
        then hovers.
        """
        path = with_rest(plan.trajectory)
        time = jnp.minimum(time, total_duration(path))
        return jnp.stack([evaluate(path, time, k) for k in range(4)])

    def references(self, plan: Any, times: Array, world: World) -> Reference:
        """Return the references (planned states) at K times [s] since the start of a plan.

        A braking piece follows the plan. Later times are replaced by a time two rotor lags before
        the end of this piece, because the references look ahead in time.
        """
        path = with_rest(plan.trajectory)
        lag = self.model.rotors.lag
        times = jnp.minimum(times, total_duration(path) - 2.0 * lag)
        # Plans of other packages may have a trajectory only.
        air, heading = (getattr(plan, name, None) for name in ("air", "heading"))
        return jax.vmap(lambda time: reference_at(path, time, lag, world, air, heading))(times)

    def command(self, state: RobotState, reference: Reference, world: World) -> Array:
        """Return the rotor thrusts (4,) [N] that track a reference (a planned state)."""
        return control(state, reference, self.model, self.gains, world)

    def shapes(self) -> list[Shape]:
        """Return the only part for drawing: the frame with its arms, rotors, and the tool."""
        rotors = self.model.rotors
        arms, top = rotors.positions, np.array([0.0, 0.0, self.tool.height])
        discs = [(arm, rotors.radius) for arm in arms] + [(top, self.tool.radius)]
        rims = [_circle(centre, radius, 24) for centre, radius in discs]
        lines = [arms[[0, 2]], arms[[1, 3]], np.stack([0.0 * top, top]), *rims]
        return [Shape(lines, discs, tool=True)]

    def places(self, pose: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return position [m] and quaternion w x y z of the only drawn shape at a pose (7,)."""
        return [(pose[:3], pose[3:7])]

    def place(self, poses: np.ndarray) -> np.ndarray:
        """Return the centre of the propeller plane, (..., 3) [m], at joint positions (..., 7)."""
        return poses[..., :3]

    def find_held_ball(self, pose: np.ndarray) -> np.ndarray:
        """Return the centre (3,) [m] of a ball that lies in the net; NaN with a racket."""
        up = self.tool.height - BALL_RADIUS if self.tool.kind == NET else np.nan
        return pose[:3] + up * rotation(pose[3:7], np)[:, 2]


def _circle(centre: np.ndarray, radius: float, segments: int) -> np.ndarray:
    turn = 2.0 * np.pi * np.arange(segments + 1) / segments
    return centre + radius * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
