"""An arm of n joints with a flat shield at its flange: kinematics, limits, and plans of the joints.

The joints are hinges in a chain, six or seven of them. Positions are in the robot's base frame, z
up, SI units; joint angles are (n,) [rad]. The frame of a link lies at its joint and turns with it,
as in MuJoCo's model files.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax

from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.checks import require_values
from planner_jax.core.protocol import Plan
from planner_jax.robot.setpoints import sample_at_rate
from planner_jax.trajectory.polynomial import PiecewisePolynomial, evaluate


@struct.dataclass
class ArmLimits:
    """Greatest magnitudes of joint velocities, accelerations and torques.

    `Arm` has the limits of angles. Programs for limits without torques do not compute torques.
    """

    velocity: Array  # (n,) [rad/s]
    acceleration: Array  # (n,) [rad/s^2]
    torque: Array | None = None  # (n,) [N m], infinite for a joint without a limit; None for none


@struct.dataclass
class Arm:
    """An arm of n joints: links 1 to n, capsules around the links, base and shield."""

    origin: Array  # (n, 3) [m], position of each joint in the frame of the previous link
    turn: Array  # (n, 4) unit quaternion w, x, y, z: rotation of the joint's frame at angle 0
    axis: Array  # (n, 3) unit vector along each joint's axis, in the joint's frame
    lower: Array  # (n,) [rad], least joint angles
    upper: Array  # (n,) [rad], greatest joint angles
    home: Array  # (n,) [rad], joint angles at which the arm waits
    limits: ArmLimits  # greatest rates, accelerations and torques of the joints
    mass: Array  # (n,) [kg], of each link
    centre: Array  # (n, 3) [m], centre of mass of each link, in the link's frame
    inertia: Array  # (n, 3, 3) [kg m^2], of each link about its centre of mass, link's axes
    capsule_ends: Array  # (C, 2, 3) [m], ends of each capsule's axis in the frame of its link
    capsule_radius: Array  # (C,) [m]
    shield_gap_radius: Array  # (C,) [m], radius of each capsule in its distance from the shield
    base_box: Array  # (2, 3) [m], lowest and highest corner of the box around the base
    shield_centre: Array  # (3,) [m], middle of the shield's front face, in the frame of link n
    # (4,) unit quaternion w, x, y, z: rotation of the shield's frame in the frame of link n. The
    # axes of the shield's frame are the outward normal and the directions of the two edges.
    shield_turn: Array
    # (2,) [m], halves of the edges of a rectangle around the shield's middle, parallel to its two
    # edges, that contains the shield. Collisions are tested with this rectangle.
    shield_half: Array
    # (K, 2) [m], corners of the shield's convex outline along the two edges, counterclockwise
    # around the middle. Balls must be met within the outline.
    shield_corners: Array
    # (C,) link of each capsule: 0 to n - 1 are links 1 to n, -1 is the base.
    capsule_link: tuple[int, ...] = struct.field(pytree_node=False)
    # Bodies that must not touch: pairs of capsules, the first one of the later link; capsules and
    # the shield; capsules and the base box, which the shield must not touch either.
    pairs: tuple[tuple[int, int], ...] = struct.field(pytree_node=False)
    shield_pairs: tuple[int, ...] = struct.field(pytree_node=False)
    base_pairs: tuple[int, ...] = struct.field(pytree_node=False)
    joint_names: tuple[str, ...] = struct.field(pytree_node=False)
    # Whether the last joint turns the shield in its own plane, about its middle.
    turns_in_plane: bool = struct.field(pytree_node=False)
    # Method of inverse kinematics, see `arm_ik.choose_ik`.
    ik: str = struct.field(pytree_node=False, default="spherical")
    # (n,) [kg m^2], inertia of each motor's rotor, multiplied by the squared ratio of its gear;
    # None if the arm's file has none.
    armature: Array | None = None

    @property
    def num(self) -> int:
        """Number n of joints; leading axes of a batch of arms are not counted."""
        return self.origin.shape[-2]


@struct.dataclass
class Regime:
    """Joint limits of an arm, and whether its motions have to end at rest."""

    limits: ArmLimits
    ends_at_rest: bool = struct.field(pytree_node=False)


def _regime(factor: float, acceleration: float, ends_at_rest: bool) -> Regime:
    speeds = np.deg2rad(np.array([150, 160, 170, 320, 400, 450], np.float32))
    limits = ArmLimits(host_leaf(factor * speeds), host_leaf(np.full(6, acceleration, np.float32)))
    return Regime(limits=limits, ends_at_rest=ends_at_rest)


# Joint limits of the arm IRB 1600-6/1.2. R1: limits in the code of [Natarajan2024]; motions may end
# at any velocity. R2: speeds of the data sheet, and 30 rad/s^2 as an assumption, since the data
# sheet states no accelerations; motions end at rest. R3: limits of R1; motions end at rest.
REGIMES = {
    "R1": _regime(2.0, 60.0, ends_at_rest=False),
    "R2": _regime(1.0, 30.0, ends_at_rest=True),
    "R3": _regime(2.0, 60.0, ends_at_rest=True),
}


def product(a: Array, b: Array) -> Array:
    """Return the matrix product a b without the reduced precision that GPUs use by default."""
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def quaternion_rotation(quaternion: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of unit quaternions (..., 4), w x y z."""
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _joint_rotations(arm: Arm, angles: Array) -> Array:
    """Return rotations (n, 3, 3) of links relative to the previous links, at angles (n,) [rad]."""
    turn = quaternion_rotation(jnp.asarray(arm.turn))
    axis = jnp.asarray(arm.axis)
    x, y, z = axis[:, 0], axis[:, 1], axis[:, 2]
    none = jnp.zeros_like(x)
    cross = jnp.stack([none, -z, y, z, none, -x, -y, x, none], axis=-1).reshape(-1, 3, 3)
    # `along` and `across` do not depend on the angles: `vmap` over angles computes them only once.
    along = product(turn, axis[:, :, None] * axis[:, None, :])
    across = product(turn, cross)
    cos, sin = jnp.cos(angles)[:, None, None], jnp.sin(angles)[:, None, None]
    return along + cos * (turn - along) + sin * across


def link_frames(arm: Arm, angles: Array) -> tuple[Array, Array]:
    """Return links' rotations (n, 3, 3) to the base frame and joints' positions (n, 3) [m]."""
    turned = _joint_rotations(arm, angles)
    origin = jnp.asarray(arm.origin)
    rotations, positions = [turned[0]], [origin[0]]
    for k in range(1, arm.num):
        positions.append(positions[-1] + product(rotations[-1], origin[k]))
        rotations.append(product(rotations[-1], turned[k]))
    return jnp.stack(rotations), jnp.stack(positions)


def joint_axes(arm: Arm, rotations: Array) -> Array:
    """Return the joint axes (n, 3) in the base frame, given the links' rotations (n, 3, 3)."""
    return product(rotations, jnp.asarray(arm.axis)[:, :, None])[:, :, 0]


def shield_pose(arm: Arm, angles: Array) -> tuple[Array, Array]:
    """Return the shield's rotation (3, 3) and its face's middle (3,) [m], at angles (n,) [rad].

    The columns of the rotation are the outward normal and the two edges, in the base frame.
    """
    rotations, positions = link_frames(arm, angles)
    last, turn = rotations[-1], quaternion_rotation(jnp.asarray(arm.shield_turn))
    middle = positions[-1] + product(last, jnp.asarray(arm.shield_centre))
    return product(last, turn), middle


def shield_sides(arm: Arm) -> Array:
    """Return vectors s (K, 2) [1/m] of the K sides of the shield's outline.

    A point p of the shield's plane, relative to the middle, is within the outline if  s . p <= 1
    for all sides. The side's distance from the middle is  1 / |s|.
    """
    corners = jnp.asarray(arm.shield_corners)
    along = jnp.roll(corners, -1, axis=0) - corners
    normal = jnp.stack([along[:, 1], -along[:, 0]], axis=1)
    return normal / jnp.sum(normal * corners, axis=1, keepdims=True)


def shield_inradius(arm: Arm) -> Array:
    """Return the radius () [m] of the greatest disc around the shield's middle in its outline."""
    return 1.0 / jnp.sqrt(jnp.max(jnp.sum(shield_sides(arm) ** 2, axis=1)))


def reach_of(arm: Arm) -> float:
    """Return the greatest distance [m] of the shield from joint 2: the sum of link lengths."""
    ends = np.concatenate([arm.origin[2:], np.asarray(arm.shield_centre)[None]])
    return float(np.linalg.norm(ends, axis=1).sum())


def shield_jacobian(arm: Arm, angles: Array) -> Array:
    """Return the geometric Jacobian (6, n) of the shield at angles (n,) [rad], in the base frame.

    Each column belongs to a joint. Rows 0 to 2 are the velocity of the middle of the shield's face
    for a joint rate of 1 rad/s, [m/rad]. Rows 3 to 5 are the angular velocity.
    """
    rotations, positions = link_frames(arm, angles)
    axes = joint_axes(arm, rotations)
    middle = positions[-1] + product(rotations[-1], jnp.asarray(arm.shield_centre))
    return jnp.concatenate([jnp.cross(axes, middle[None] - positions), axes], axis=1).T


def capsules(arm: Arm, angles: Array) -> Array:
    """Return the ends (C, 2, 3) [m] of the axes of C capsules in the base frame, at angles (n,)."""
    rotations, positions = link_frames(arm, angles)
    # Append the base as the last link, since the base has the index -1 in `arm.capsule_link`.
    rotations = jnp.concatenate([rotations, jnp.eye(3, dtype=rotations.dtype)[None]])
    positions = jnp.concatenate([positions, jnp.zeros((1, 3), positions.dtype)])
    link = np.asarray(arm.capsule_link, np.int32)
    turned = product(jnp.asarray(arm.capsule_ends), jnp.swapaxes(rotations[link], 1, 2))
    return positions[link][:, None] + turned


@dataclasses.dataclass(frozen=True)
class ArmSetpoints:
    """Samples of an arm's plan at K equally spaced times.

    In a batch every array but `time` has a leading axis B. Entries after a plan's end are NaN.
    """

    time: np.ndarray  # (K,) [s] since the start of the plan
    angles: np.ndarray  # (K, n) [rad], joint angles
    rates: np.ndarray  # (K, n) [rad/s]
    accelerations: np.ndarray  # (K, n) [rad/s^2]


@struct.dataclass
class ArmPlan(Plan):
    """A plan of an arm: the motion of its n joints.

    Attributes:
        motion: joint angles [rad] over time: M pieces with the coefficients (M, D + 1, n).
    """

    motion: PiecewisePolynomial

    def sample(self, rate: float) -> ArmSetpoints:
        """Sample the plan, or the batch of plans, `rate` times a second from start to end.

        Raises:
            ValueError: the rate is not positive.
        """
        require_values("sample", self)
        ends = np.sum(np.asarray(self.motion.durations), axis=-1)
        return ArmSetpoints(**sample_at_rate(rate, ends, self.motion, _setpoint_at))


def _setpoint_at(motion: PiecewisePolynomial, time: Array) -> dict[str, Array]:
    names = ("angles", "rates", "accelerations")
    return {name: evaluate(motion, time, order) for order, name in enumerate(names)}
