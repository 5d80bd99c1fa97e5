"""Inverse kinematics in closed form, of arms that are ortho-parallel with a spherical wrist.

Brandstoetter, Angerer and Hofbaur, "An analytical solution of the inverse kinematics problem of
industrial serial manipulators with an ortho-parallel basis and a spherical wrist" (2014): axis 2
is across axis 1, axis 3 along axis 2, and axes 4, 5 and 6 meet in one point, the centre of the
wrist, each across the next. Their seven lengths a1, a2, b, c1, c2, c3, c4 are taken from the
frames of an `Arm`, wherever these frames lie and whichever way the joints turn.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from scipy.spatial.transform import Rotation

from planner_jax.robot.arm import Arm, joint_axes, link_frames, product

# Whether the arm faces the wrist's centre (1) or reaches it over its shoulder (-1), and on which
# side of the line between the two the elbow is.
_ARM_BRANCHES = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)]).T
# Largest deviation [m or rad] from the geometry that the closed form is for.
_MISFIT = 1e-5


@struct.dataclass
class _Geometry:
    """What the closed form needs of an arm at angle 0, in the axes x, y, z of its basis.

    z is axis 1, y axis 2, and the origin is on axis 1, where joint 1 is.
    """

    basis: Array  # (3, 3), columns x, y, z in the base frame
    origin: Array  # (3,) [m], in the base frame
    shoulder: Array  # (2,) [m] x and z of axis 2: a1 and c1
    lateral: Array  # () [m] y of the wrist's centre: b
    upper_arm: Array  # () [m], axis 2 to axis 3: c2
    forearm: Array  # () [m], axis 3 to the wrist's centre: sqrt(a2^2 + c3^2)
    upper_arm_angle: Array  # () [rad] about y, from z to the upper arm
    forearm_angle: Array  # () [rad] about y, from z to the forearm
    elbow_sign: Array  # (), 1 where axis 3 points along axis 2, -1 where against it
    wrist: Array  # (3,) [m], centre of the wrist in the frame of link 6: c4 off the flange
    before: Array  # (3, 3), columns axis 4, axis 5 and across them, in the basis
    after: Array  # (3, 3), columns axis 6, axis 5 and across them, in the frame of link 6
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
    """Return all angles at which the shield is where it is wanted: the eight branches.

    Branch 4 i + 2 j + k has the wrist in front of the shoulder (i = 0) or reached over it (1),
    the elbow on one side or the other (j), the wrist bent one way or the other (k). Where joint
    axes fall together, 4 and 6 at a straight wrist or 1 with the wrist on it, the first of these
    joints is put at its zero.

    Args:
        arm: one arm; the geometry is not checked here, `read_arm` does.
        rotation: (3, 3), of the shield in the base frame: outward normal and edges its columns.
        middle: (3,) [m], of its front face, in the base frame.

    Returns:
        angles: (8, 6) [rad]; of equal angles the nearest to the middle of the joint's range, which
            for joints 4 and 6 of most arms means within +-pi. Out of reach they are those of an arm
            stretched towards the pose, or folded: finite, with finite gradients.
        found: (8,) bool, whether the pose is reached within the position limits.
    """
    geometry = _geometry(arm)
    shield = jnp.asarray(arm.shield_centre)
    wrist = middle + product(rotation, geometry.wrist - shield) - geometry.origin
    wrist = product(geometry.basis.T, wrist)
    tip = product(product(geometry.basis.T, rotation), geometry.after)

    def branches(front: Array, elbow: Array) -> tuple[Array, Array]:
        first, reached = _arm_angles(geometry, wrist, front, elbow)
        pitch = first[1] + geometry.elbow_sign * first[2]
        turned = product(_about_z(first[0]), product(_about_y(pitch), geometry.before))
        wanted = product(turned.T, tip)
        both = [jnp.append(first, _wrist_angles(wanted, flip, geometry.bend)) for flip in (1, -1)]
        return jnp.stack(both), jnp.stack([reached, reached])

    angles, reached = jax.vmap(branches)(*jnp.asarray(_ARM_BRANCHES, wrist.dtype))
    angles, reached = angles.reshape(8, 6), reached.reshape(8)
    lower, upper = jnp.asarray(arm.lower), jnp.asarray(arm.upper)
    turns = jnp.round((angles - 0.5 * (lower + upper)) / (2.0 * jnp.pi))
    angles = angles - 2.0 * jnp.pi * turns
    return angles, reached & jnp.all((angles >= lower) & (angles <= upper), axis=1)


def _arm_angles(
    geometry: _Geometry, wrist: Array, front: Array, elbow: Array
) -> tuple[Array, Array]:
    """Return joints 1 to 3 (3,) [rad] that put the wrist's centre at (3,) [m]; whether they can."""
    x, y, z = wrist
    lateral, upper_arm, forearm = geometry.lateral, geometry.upper_arm, geometry.forearm
    # Rounding must not take a pose at the very end of the reach out of it.
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


def _wrist_angles(wanted: Array, flip: int, bend: Array) -> Array:
    """Return joints 4 to 6 (3,) [rad] of X(j4) Y(j5 + bend) X(j6) = rotation (3, 3), one branch."""
    fourth = _angle(flip * wanted[1, 0], -flip * wanted[2, 0])
    sine, cosine = jnp.sin(fourth), jnp.cos(fourth)
    # What joint 4 leaves is well determined at a straight wrist too, where joint 4 is not.
    fifth = _angle(sine * wanted[1, 0] - cosine * wanted[2, 0], wanted[0, 0])
    left = cosine * wanted[1] + sine * wanted[2]
    return jnp.stack([fourth, fifth - bend, _angle(-left[2], left[1])])


def _angle(y: Array, x: Array) -> Array:
    """Return the angle atan2(y, x); 0 with no slope where it is not defined."""
    none = x * x + y * y <= jnp.finfo(x.dtype).eps ** 2
    return jnp.arctan2(jnp.where(none, 0.0, y), jnp.where(none, 1.0, x))


def _root(x: Array) -> Array:
    """Return square root of x (...), 0 with no slope where x is not positive."""
    positive = x > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def _about_z(angle: Array) -> Array:
    sin, cos = jnp.sin(angle), jnp.cos(angle)
    none, one = jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.stack([cos, -sin, none, sin, cos, none, none, none, one]).reshape(3, 3)


def _about_y(angle: Array) -> Array:
    sin, cos = jnp.sin(angle), jnp.cos(angle)
    none, one = jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.stack([cos, none, sin, none, one, none, -sin, none, cos]).reshape(3, 3)


def misfit(arm: Arm) -> str | None:
    """Return why the closed form does not fit an arm with NumPy leaves; None if it fits."""
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
    for name, way in (
        ("2 and 3", positions[2] - positions[1]),
        ("3 and the wrist's centre", centre - positions[2]),
    ):
        if np.linalg.norm(np.cross(axes[1], way)) <= _MISFIT:
            return f"there must be a distance between axis {name}"
    return None
