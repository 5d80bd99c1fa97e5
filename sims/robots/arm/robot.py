"""The simulated arm, a `sims.robot.Robot`: n hinges on a fixed base.

`qpos` starts with the joint angles, `qvel` with the joint rates, and the actuators are joint
torques. The base frame of plans is parallel to the world frame and lies above the ground. The
simulation has no joint stops and no collisions. The score of a flight checks position limits and
collisions afterwards.
"""

import dataclasses
import functools
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial.transform import Rotation

from planner_jax.referee.arm_clearance import links_of, shield_pose
from planner_jax.robot.arm import Arm
from planner_jax.robot.arm_file import irb1600
from planner_jax.robot.arm_scene_file import shield_arm
from planner_jax.sims.model import World
from planner_jax.sims.robot import Physics, Shape, Solid, rotation
from planner_jax.sims.robots.arm.control import (
    Course,
    Gains,
    JointReference,
    JointState,
    control,
    reference_at,
)
from planner_jax.sims.robots.arm.drives import TORQUES
from planner_jax.sims.scenery import VISUAL, box_solid, capsule_solid, hull, xml_numbers

_THICKNESS = 0.01  # [m], thickness of the shield


def lanes_of(arm: Arm) -> dict[str, np.ndarray]:
    """Return an arm's geometry as float64 arrays with a batch axis of length one.

    The names, such as "arm.origin", are the names that the referee's function `links_of` reads.
    """
    names = ("origin", "turn", "axis", "shield_centre", "shield_turn")
    return {f"arm.{name}": np.asarray(getattr(arm, name), float)[None] for name in names}


@functools.cache
def _read(file: str | None, tip: str | None, shield: str | None) -> Arm:
    if file is None and shield is None:
        return irb1600(np.float64)
    return jax.tree.map(lambda leaf: np.asarray(leaf, float), shield_arm(file, tip, shield))


@dataclasses.dataclass(frozen=True)
class ShieldArm:
    """A simulated arm with a shield, by default the IRB 1600; static under `jax.jit`.

    The bodies have the masses and inertias of the arm's file. The joints have no friction.
    """

    base_height: float = 0.0  # [m], height of the base frame above the ground
    gains: Gains = Gains()
    file: str | None = None  # MJCF or URDF of another arm
    tip: str | None = None  # body or site of this arm that carries the shield
    shield: str | None = None  # outline of the shield, a text that `read_shield` reads

    WORDS: ClassVar[str] = (
        "an arm with limited torques that lag, computed-torque control from encoder measurements"
    )

    @property
    def arm(self) -> Any:
        """The `Arm` for which plans are made, with NumPy float64 leaves."""
        return _read(self.file, self.tip, self.shield)

    @property
    def torques(self) -> tuple[float, ...]:
        """The torque limits [N m] of the joints; infinite where the arm's file states none."""
        if self.file is None:
            return TORQUES
        torque = self.arm.limits.torque
        return tuple(torque.tolist()) if torque is not None else (math.inf,) * self.arm.num

    @property
    def num_pos(self) -> int:
        """The number n of joints."""
        return self.arm.num

    num_vel = num_pos

    @property
    def noise_shape(self) -> tuple[int, ...]:
        """Shape of the encoders' noise: angles and rates of n joints."""
        return 2, self.num_pos

    def mjcf(self) -> tuple[str, str]:
        """Return two texts in MJCF, MuJoCo's format: the links with the shield, and the motors."""
        arm = self.arm
        num = arm.num
        solids = {k: [] for k in range(-1, num)}
        for link, ends, radius in zip(
            arm.capsule_link, arm.capsule_ends, arm.capsule_radius, strict=True
        ):
            # MuJoCo rejects capsules of length zero.
            ends = ends + [[0.0, 0.0, 0.0], [1e-6, 0.0, 0.0]]
            solids[link].append(
                f'<geom type="capsule" fromto="{xml_numbers(*np.ravel(ends))}" '
                f'size="{xml_numbers(radius)}" rgba=".9 .6 .2 1" {VISUAL}/>'
            )
        middle, half = _box(arm.base_box)
        if half.all():
            solids[-1].append(
                f'<geom type="box" pos="{xml_numbers(*middle)}" size="{xml_numbers(*half)}" '
                f'rgba=".3 .3 .3 1" {VISUAL}/>'
            )
        plate = [0.5 * _THICKNESS, *arm.shield_half]
        turn = rotation(arm.shield_turn, np)
        behind = arm.shield_centre - 0.5 * _THICKNESS * turn[:, 0]
        solids[num - 1].append(
            f'<geom name="shield" type="box" pos="{xml_numbers(*behind)}" '
            f'quat="{xml_numbers(*arm.shield_turn)}" '
            f'size="{xml_numbers(*plate)}" rgba=".2 .5 .8 1" {VISUAL}/>'
        )
        base = f'<body name="base" pos="{xml_numbers(0.0, 0.0, self.base_height)}">'
        chain = "".join(self._link(k) + "".join(solids[k]) for k in range(num))
        motors = "".join(f'<motor joint="joint_{k + 1}"/>' for k in range(num))
        return base + "".join(solids[-1]) + chain + (num + 1) * "</body>", motors

    def _link(self, k: int) -> str:
        arm = self.arm
        inertia, rotor = arm.inertia[k], 0.0 if arm.armature is None else arm.armature[k]
        full = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
        return (
            f'<body name="link_{k + 1}" pos="{xml_numbers(*arm.origin[k])}" '
            f'quat="{xml_numbers(*arm.turn[k])}">'
            f'<joint name="joint_{k + 1}" type="hinge" axis="{xml_numbers(*arm.axis[k])}" '
            f'armature="{xml_numbers(rotor)}"/>'
            f'<inertial pos="{xml_numbers(*arm.centre[k])}" mass="{xml_numbers(arm.mass[k])}" '
            f'fullinertia="{xml_numbers(*full)}"/>'
        )

    def at_rest(self, place: Array, gravity: float) -> tuple[Array, Array, Array]:
        """Return joint angles `arm.home`, zero rates, and no actuator states; ignore `place`."""
        home = jnp.asarray(self.arm.home, place.dtype)
        return home, jnp.zeros_like(home), jnp.zeros(0, place.dtype)

    def drive(self, physics: Physics, command: Array, timestep: float) -> tuple[Array, Array]:
        """Return the command unchanged, as joint torques (n,) [N m], and zero extra forces."""
        return command, jnp.zeros_like(command)

    def state(self, physics: Physics) -> JointState:
        """Return the true joint angles and rates from the simulated physics."""
        return JointState(angles=physics.qpos, rates=physics.qvel)

    def sense(self, state: JointState, noise: Array, stds: Any) -> JointState:
        """Return joint angles and rates as the encoders measure them.

        Args:
            state: the true state.
            noise: (2, n) standard normal.
            stds: (2,), standard deviations of an angle [rad] and of a rate [rad/s].
        """
        errors = jnp.asarray(stds, noise.dtype)[:, None] * noise
        return JointState(angles=state.angles + errors[0], rates=state.rates + errors[1])

    def references(self, plan: Course, times: Array, world: World) -> JointReference:
        """Return the references (planned joint states) at K times (K,) [s]; leaves (K, ...).

        MuJoCo's stored rates belong to half a step before the angles, so that the reference rates
        are taken half a step earlier. A torque acts during the next step, so that the reference
        accelerations are taken half a step later.
        """
        half = 0.5 * world.timestep

        def at(time: Array) -> JointReference:
            reference, ahead = reference_at(plan, time), reference_at(plan, time + half)
            rates = reference.rates - half * reference_at(plan, time - half).accelerations
            return dataclasses.replace(reference, rates=rates, accelerations=ahead.accelerations)

        return jax.vmap(at)(times)

    def command(
        self, state: JointState, reference: JointReference, world: World, mass_error: Any = 0.0
    ) -> Array:
        """Return the torques (n,) [N m] that track a reference (a planned joint state).

        The controller's masses and inertias are the true ones times 1 + `mass_error`.
        """
        dtype = state.angles.dtype
        arm = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), self.arm)
        factor = 1.0 + mass_error
        believed = dataclasses.replace(arm, mass=factor * arm.mass, inertia=factor * arm.inertia)
        return control(state, reference, believed, self.gains, world.gravity)

    def shapes(self) -> list[Shape]:
        """Return the parts for drawing: base, links 1 to n with their capsules, and shield."""
        arm = self.arm
        solids: list[list[Solid]] = [[] for _ in range(arm.num + 1)]
        if np.ptp(arm.base_box, axis=0).all():
            solids[0].append(box_solid(*arm.base_box))
        for link, ends, radius in zip(
            arm.capsule_link, arm.capsule_ends, arm.capsule_radius, strict=True
        ):
            solids[link + 1].append(capsule_solid(ends[0], ends[1], float(radius)))
        turn, corners = rotation(arm.shield_turn, np), np.pad(arm.shield_corners, ((0, 0), (1, 0)))
        face = arm.shield_centre + corners @ turn.T
        plate = hull(np.concatenate([face, face - _THICKNESS * turn[:, 0]]))
        rim = np.concatenate([face, face[:1]])
        return [
            *(Shape([], [], solids=tuple(each)) for each in solids),
            Shape([rim], [], tool=True, solids=(plate,)),
        ]

    def places(self, pose: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return positions [m] and quaternions w x y z of base, links and shield.

        `pose` are the joint angles (n,) [rad]; positions are in the world frame.
        """
        turns, places = links_of(lanes_of(self.arm), np.reshape(pose, (-1, 1, 1)))
        base = np.array([0.0, 0.0, self.base_height])
        found = [(base, np.array([1.0, 0.0, 0.0, 0.0]))]
        for turn, place in zip(turns, places, strict=True):
            quat = Rotation.from_matrix(turn[..., 0, 0]).as_quat(scalar_first=True)
            found.append((base + np.broadcast_to(place, (3, 1, 1))[:, 0, 0], quat))
        return [*found, found[-1]]

    def place(self, poses: np.ndarray) -> np.ndarray:
        """Return the centre of the shield's face, (..., 3) [m], at joint angles (..., n)."""
        case = lanes_of(self.arm)
        angles = np.moveaxis(np.reshape(poses, (1, -1, self.num_pos)), 2, 0)
        middle = shield_pose(case, *links_of(case, angles))[1][:, 0].T
        return middle.reshape(*np.shape(poses)[:-1], 3) + [0.0, 0.0, self.base_height]

    def find_held_ball(self, pose: np.ndarray) -> np.ndarray:
        """Return NaN (3,), since the shield holds no ball."""
        return np.full(3, np.nan)


def _box(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return 0.5 * (corners[0] + corners[1]), 0.5 * (corners[1] - corners[0])
