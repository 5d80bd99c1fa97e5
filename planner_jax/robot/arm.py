"""A six-axis arm with a square shield at its flange: kinematics, limits, and plans of the joints.

Base frame of the robot, z up, SI units, angles of the joints (6,) [rad]. The frame of a link lies
at its joint and turns with it, as in MuJoCo's model files (`planner_jax.robot.arm_mjcf` reads one).
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.protocol import Plan
from planner_jax.robot.setpoints import sample_at_rate
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate


@struct.dataclass
class Arm:
    """Everything of an arm that planners need: joints and links 1 to 6, capsules, the shield."""

    origin: Array  # (6, 3) [m], of each joint in the frame of the link before it
    turn: Array  # (6, 4) unit quaternion w, x, y, z, of that joint's frame at angle 0
    axis: Array  # (6, 3) unit, in the joint's frame
    lower: Array  # (6,) [rad], position limits
    upper: Array  # (6,) [rad]
    home: Array  # (6,) [rad], where the arm waits
    mass: Array  # (6,) [kg]
    centre: Array  # (6, 3) [m], of mass, in the link's frame
    inertia: Array  # (6, 3, 3) [kg m^2], about the centre of mass, along the link's axes
    capsule_ends: Array  # (C, 2, 3) [m], in the frame of its link
    capsule_radius: Array  # (C,) [m]
    base_box: Array  # (2, 3) [m], lowest and highest corner of the base
    shield_centre: Array  # (3,) [m], middle of the shield's front face, in the frame of link 6
    shield_half: Array  # () [m], half of an edge; outward normal +x of link 6, edges y and z
    capsule_link: tuple[int, ...] = struct.field(
        pytree_node=False
    )  # (C,) 0 to 5: links 1 to 6, -1: base


@struct.dataclass
class ArmLimits:
    """What the joints may not exceed, either way; an arm has its position limits itself."""

    velocity: Array  # (6,) [rad/s]
    acceleration: Array  # (6,) [rad/s^2]


@struct.dataclass
class Regime:
    """How an arm is driven: its limits, and whether a motion has to end at rest."""

    limits: ArmLimits
    ends_at_rest: bool = struct.field(pytree_node=False)


def _regime(factor: float, acceleration: float, ends_at_rest: bool) -> Regime:
    """Return a regime of the IRB 1600-6/1.2 at `factor` times the speeds of its datasheet."""
    speeds = np.deg2rad(np.array([150, 160, 170, 320, 400, 450], np.float32))
    accelerations = np.full(6, acceleration, np.float32)
    limits = ArmLimits(host_leaf(factor * speeds), host_leaf(accelerations))
    return Regime(limits=limits, ends_at_rest=ends_at_rest)


# Of the IRB 1600-6/1.2: what the code of [Natarajan2024] allows, the datasheet's speeds with an
# acceleration as it is usual (the sheet has none), and the former with an end at rest.
REGIMES = {
    "R1": _regime(2.0, 60.0, ends_at_rest=False),
    "R2": _regime(1.0, 30.0, ends_at_rest=True),
    "R3": _regime(2.0, 60.0, ends_at_rest=True),
}


def product(a: Array, b: Array) -> Array:
    """Return matrix product in the full precision of its arguments."""
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def quaternion_rotation(quaternion: Array) -> Array:
    """Return rotations (..., 3, 3) of unit quaternions (..., 4), w x y z."""
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _joint_rotations(arm: Arm, angles: Array) -> Array:
    """Return rotations (6, 3, 3) of links to those before: Rodrigues' formula on each axis."""
    turn = quaternion_rotation(jnp.asarray(arm.turn))
    axis = jnp.asarray(arm.axis)
    x, y, z = axis[:, 0], axis[:, 1], axis[:, 2]
    none = jnp.zeros_like(x)
    cross = jnp.stack([none, -z, y, z, none, -x, -y, x, none], axis=-1).reshape(6, 3, 3)
    # These products are of the arm alone: once for all lanes of a batch of angles.
    along = product(turn, axis[:, :, None] * axis[:, None, :])
    across = product(turn, cross)
    cos, sin = jnp.cos(angles)[:, None, None], jnp.sin(angles)[:, None, None]
    return along + cos * (turn - along) + sin * across


def link_frames(arm: Arm, angles: Array) -> tuple[Array, Array]:
    """Return where the links are at angles (6,) [rad].

    Returns:
        rotations: (6, 3, 3), link to base.
        positions: (6, 3) [m], of the joints in the base frame.
    """
    turned = _joint_rotations(arm, angles)
    origin = jnp.asarray(arm.origin)
    rotations, positions = [turned[0]], [origin[0]]
    for k in range(1, 6):
        positions.append(positions[-1] + product(rotations[-1], origin[k]))
        rotations.append(product(rotations[-1], turned[k]))
    return jnp.stack(rotations), jnp.stack(positions)


def joint_axes(arm: Arm, rotations: Array) -> Array:
    """Return directions (6, 3) of the joints in the base frame by links' rotations (6, 3, 3)."""
    return product(rotations, jnp.asarray(arm.axis)[:, :, None])[:, :, 0]


def shield_pose(arm: Arm, angles: Array) -> tuple[Array, Array]:
    """Return the shield's rotation (3, 3) at angles (6,) and the middle (3,) [m] of its face.

    The columns of the rotation are the outward normal and the directions of the edges.
    """
    rotations, positions = link_frames(arm, angles)
    return rotations[5], positions[5] + product(rotations[5], jnp.asarray(arm.shield_centre))


def shield_jacobian(arm: Arm, angles: Array) -> Array:
    """Return how the shield moves with each joint at angles (6,): the geometric Jacobian (6, 6).

    Its first three rows are the velocity of the middle of the front face [m/rad], the last three
    the angular velocity [rad/rad], both in the base frame; a column a joint.
    """
    rotations, positions = link_frames(arm, angles)
    axes = joint_axes(arm, rotations)
    middle = positions[5] + product(rotations[5], jnp.asarray(arm.shield_centre))
    return jnp.concatenate([jnp.cross(axes, middle - positions), axes], axis=1).T


def capsules(arm: Arm, angles: Array) -> Array:
    """Return ends (C, 2, 3) [m] of the capsules' segments in the base frame, at angles (6,)."""
    rotations, positions = link_frames(arm, angles)
    # The base is the last one, where -1 finds it.
    rotations = jnp.concatenate([rotations, jnp.eye(3, dtype=rotations.dtype)[None]])
    positions = jnp.concatenate([positions, jnp.zeros((1, 3), positions.dtype)])
    link = np.asarray(arm.capsule_link, np.int32)
    turned = product(jnp.asarray(arm.capsule_ends), jnp.swapaxes(rotations[link], 1, 2))
    return positions[link][:, None] + turned


@dataclasses.dataclass(frozen=True)
class ArmSetpoints:
    """A plan at K equally spaced times; of a batch every array but `time` has a leading axis B.

    Entries past the end of a plan are NaN.
    """

    time: np.ndarray  # (K,) [s] since the plan began
    angles: np.ndarray  # (K, 6) [rad], of the joints
    rates: np.ndarray  # (K, 6) [rad/s]
    accelerations: np.ndarray  # (K, 6) [rad/s^2]


@struct.dataclass
class ArmPlan(Plan):
    """A plan with the motion of an arm's joints, coefficients (M, D + 1, 6) in [rad]."""

    motion: PiecewisePolynomial

    def sample(self, rate: float) -> ArmSetpoints:
        """Sample the plan, or the batch, at a rate [Hz], from its beginning up to its end.

        Raises:
            ValueError: the rate is not positive.
        """
        ends = np.sum(np.asarray(self.motion.durations), axis=-1)
        return ArmSetpoints(**sample_at_rate(rate, ends, self.motion, _setpoint_at))


def _setpoint_at(motion: PiecewisePolynomial, time: Array) -> dict[str, Array]:
    """Return one setpoint of one motion at a time () [s]."""
    names = ("angles", "rates", "accelerations")
    return {name: evaluate(motion, time, order) for order, name in enumerate(names)}
