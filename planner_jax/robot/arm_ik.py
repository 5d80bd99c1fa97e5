"""Inverse kinematics in closed form, for ortho-parallel arms with a spherical wrist.

The method is from [Brandstoetter2014], which describes an arm by seven lengths. Axis 2 is
perpendicular to axis 1, and axis 3 parallel to axis 2. Axes 4, 5 and 6 meet in the wrist centre,
and axis 5 is perpendicular to axes 4 and 6.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from scipy.spatial.transform import Rotation

from planner_jax.robot.arm import Arm, joint_axes, link_frames, product

# The four solutions for joints 1 to 3, one a column. Row 0: 1 if the arm faces the wrist centre, -1
# if it reaches over its shoulder. Row 1: 1 or -1 for the side of the line from shoulder to wrist
# centre on which the elbow is.
_ARM_BRANCHES = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)]).T
_MISFIT = 1e-5  # [m] or [rad], largest deviation from the geometry that the closed form assumes


@struct.dataclass
class _Geometry:
    """Lengths and angles of an arm at joint angles 0; a1 to c4 are lengths of [Brandstoetter2014].

    The coordinates x, y, z have their origin at joint 1; z is along axis 1 and y along axis 2.
    """

    basis: Array  # (3, 3), columns are the directions of x, y, z in the base frame
    origin: Array  # (3,) [m], position of joint 1 in the base frame
    shoulder: Array  # (2,) [m], x and z of axis 2: a1 and c1
    lateral: Array  # () [m], y of the wrist centre: b
    upper_arm: Array  # () [m], length from axis 2 to axis 3: c2
    forearm: Array  # () [m], length from axis 3 to the wrist centre: sqrt(a2^2 + c3^2)
    upper_arm_angle: Array  # () [rad] about y, from z to the upper arm
    forearm_angle: Array  # () [rad] about y, from z to the forearm
    elbow_sign: Array  # (), 1 if axis 3 has the direction of axis 2, -1 if the opposite one
    wrist: Array  # (3,) [m], wrist centre in the frame of link 6: c4 off the flange
    before: Array  # (3, 3), columns axis 4, axis 5 and their cross product, in the basis
    after: Array  # (3, 3), columns axis 6, axis 5 and their cross product, in link 6's frame
    bend: Array  # () [rad], angle about axis 5 from axis 4 to axis 6


def _geometry(arm: Arm) -> _Geometry:
    rotations, positions = link_frames(arm, jnp.zeros(6, jnp.result_type(arm.origin)))
    axes = joint_axes(arm, rotations)
    basis = jnp.stack([jnp.cross(axes[1], axes[0]), axes[1], axes[0]], axis=1)
    origin = positions[0]
    centre = positions[3] + axes[3] * jnp.sum(axes[3] * (positions[4] - positions[3]))
    shoulder, elbow, wrist = (
        product(basis.T, place - origin) for place in (positions[1], positions[2], centre)
    )
    upper_arm, forearm = elbow - shoulder, wrist - elbow
    before = jnp.stack([axes[3], axes[4], jnp.cross(axes[3], axes[4])], axis=1)
    after = jnp.stack([axes[5], axes[4], jnp.cross(axes[5], axes[4])], axis=1)
    return _Geometry(
        basis=basis,
        origin=origin,
        shoulder=shoulder[jnp.array([0, 2])],
        lateral=wrist[1],
        upper_arm=jnp.hypot(upper_arm[0], upper_arm[2]),
        forearm=jnp.hypot(forearm[0], forearm[2]),
        upper_arm_angle=jnp.arctan2(upper_arm[0], upper_arm[2]),
        forearm_angle=jnp.arctan2(forearm[0], forearm[2]),
        elbow_sign=jnp.sign(jnp.sum(axes[1] * axes[2])),
        wrist=product(rotations[5].T, centre - positions[5]),
        before=product(basis.T, before),
        after=product(rotations[5].T, after),
        bend=jnp.arctan2(-jnp.sum(axes[5] * before[:, 2]), jnp.sum(axes[5] * axes[3])),
    )


def inverse_kinematics(arm: Arm, rotation: Array, middle: Array) -> tuple[Array, Array]:
    """Return the eight solutions for the joint angles that bring the shield to a pose.

    Solution 4 i + 2 j + k: i = 0 if the arm faces the wrist centre, 1 if it reaches over its
    shoulder; j = 0 or 1 for the side of the elbow; k = 0 or 1 for the sign of the wrist's bend
    about axis 5. At a singularity, such as a straight wrist, where axes 4 and 6 coincide, one joint
    angle is not determined. The joint with the lower number is then set to zero.

    Args:
        arm: one arm; `read_arm` checks its geometry, this function does not.
        rotation: (3, 3), from shield to base frame; columns are the outward normal and the edges.
        middle: (3,) [m], middle of the shield's front face in the base frame.

    Returns:
        angles: (8, 6) [rad], each shifted by multiples of 2 pi to be nearest to the middle of the
            joint's range. If the pose is out of reach, the arm is stretched towards it, or folded;
            values and gradients are finite.
        found: (8,) bool, whether the pose is reached and all joint angles are within their limits.
    """
    geometry = _geometry(arm)
    shield = jnp.asarray(arm.shield_centre)
    wrist = middle + product(rotation, geometry.wrist - shield) - geometry.origin
    wrist = product(geometry.basis.T, wrist)
    tip = product(product(geometry.basis.T, rotation), geometry.after)

    def branches(front: Array, elbow: Array) -> tuple[Array, Array]:
        first, reached = _arm_angles(geometry, wrist, front, elbow)
        pitch = first[1] + geometry.elbow_sign * first[2]
        turned = product(_turn_about(2, first[0]), product(_turn_about(1, pitch), geometry.before))
        turn = product(turned.T, tip)
        both = [jnp.append(first, _wrist_angles(turn, flip, geometry.bend)) for flip in (1, -1)]
        return jnp.stack(both), jnp.stack([reached, reached])

    angles, reached = jax.vmap(branches)(*jnp.asarray(_ARM_BRANCHES, wrist.dtype))
    angles, reached = angles.reshape(8, 6), reached.reshape(8)
    lower, upper = jnp.asarray(arm.lower)[None], jnp.asarray(arm.upper)[None]
    angles = angles - 2.0 * jnp.pi * jnp.round((angles - 0.5 * (lower + upper)) / (2.0 * jnp.pi))
    return angles, reached & jnp.all((angles >= lower) & (angles <= upper), axis=1)


def _arm_angles(
    geometry: _Geometry, wrist: Array, front: Array, elbow: Array
) -> tuple[Array, Array]:
    """Return angles (3,) [rad] of joints 1 to 3 for a wrist centre, and whether it is reached.

    `front` and `elbow`, 1 or -1, select one of four solutions: a column of `_ARM_BRANCHES`.
    """
    x, y, z = wrist
    lateral, upper_arm, forearm = geometry.lateral, geometry.upper_arm, geometry.forearm
    # The slack allows for rounding errors at points to which the arm is fully stretched.
    slack = 16.0 * jnp.finfo(wrist.dtype).eps
    radius_squared = x * x + y * y
    ahead = front * _root(radius_squared - lateral**2)
    first = _angle(y, x) - _angle(lateral, ahead)
    across, up = ahead - geometry.shoulder[0], z - geometry.shoulder[1]
    cosine = (across**2 + up**2 - upper_arm**2 - forearm**2) / (2.0 * upper_arm * forearm)
    reached = (radius_squared >= lateral**2 * (1.0 - slack)) & (jnp.abs(cosine) <= 1.0 + slack)
    cosine = jnp.clip(cosine, -1.0, 1.0)
    sine = elbow * _root((1.0 - cosine) * (1.0 + cosine))
    folded = _angle(forearm * sine, upper_arm + forearm * cosine)
    second = _angle(across, up) - folded - geometry.upper_arm_angle
    third = _angle(sine, cosine) - (geometry.forearm_angle - geometry.upper_arm_angle)
    return jnp.stack([first, second, geometry.elbow_sign * third]), reached


def _wrist_angles(turn: Array, flip: int, bend: Array) -> Array:
    """Return the angles j4, j5, j6 (3,) [rad] that solve X(j4) Y(j5 + bend) X(j6) = turn (3, 3).

    X and Y are rotations about the x and y axes. `flip`, 1 or -1, selects one of two solutions.
    """
    fourth = _angle(flip * turn[1, 0], -flip * turn[2, 0])
    sine, cosine = jnp.sin(fourth), jnp.cos(fourth)
    # If the wrist is straight, joint 4 is not determined; then `fourth` is zero.
    fifth = _angle(sine * turn[1, 0] - cosine * turn[2, 0], turn[0, 0])
    left = cosine * turn[1] + sine * turn[2]
    return jnp.stack([fourth, fifth - bend, _angle(-left[2], left[1])])


def _angle(y: Array, x: Array) -> Array:
    """Return atan2(y, x) [rad]; at x = y = 0 the value and its gradient are zero."""
    none = x * x + y * y <= jnp.finfo(x.dtype).eps ** 2
    return jnp.arctan2(jnp.where(none, 0.0, y), jnp.where(none, 1.0, x))


def _root(x: Array) -> Array:
    """Return the square root of x (...); for x <= 0 the value and its gradient are zero."""
    positive = x > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def _turn_about(axis: int, angle: Array) -> Array:
    """Return the rotation (3, 3) about y (axis 1) or z (axis 2) by an angle () [rad]."""
    sin, cos = jnp.sin(angle), jnp.cos(angle)
    none, one = jnp.zeros_like(angle), jnp.ones_like(angle)
    about_y = [cos, none, sin, none, one, none, -sin, none, cos]
    about_z = [cos, -sin, none, sin, cos, none, none, none, one]
    return jnp.stack(about_y if axis == 1 else about_z).reshape(3, 3)


def explain_misfit(arm: Arm) -> str | None:
    """Return why `inverse_kinematics` does not apply to an arm's geometry; None if it applies."""
    rotation, position = Rotation.identity(), np.zeros(3)
    axes, positions = np.zeros((6, 3)), np.zeros((6, 3))
    for k in range(6):
        position = position + rotation.apply(arm.origin[k])
        rotation = rotation * Rotation.from_quat(arm.turn[k], scalar_first=True)
        axes[k], positions[k] = rotation.apply(arm.axis[k]), position
    for a, b in ((0, 1), (3, 4), (4, 5)):
        if abs(axes[a] @ axes[b]) > _MISFIT:
            return f"axis {b + 1} must be at right angles to axis {a + 1}"
    if np.linalg.norm(np.cross(axes[1], axes[2])) > _MISFIT:
        return "axis 3 must be parallel to axis 2"
    centre = positions[3] + axes[3] * (axes[3] @ (positions[4] - positions[3]))
    for k in (4, 5):
        if np.linalg.norm(np.cross(axes[k], centre - positions[k])) > _MISFIT:
            return "axes 4, 5 and 6 must meet in one point"
    links = {
        "2 and 3": positions[2] - positions[1],
        "3 and the wrist centre": centre - positions[2],
    }
    for name, link in links.items():
        if np.linalg.norm(np.cross(axes[1], link)) <= _MISFIT:
            return f"there must be a distance between axis {name}"
    return None
