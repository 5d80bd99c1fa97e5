"""Inverse kinematics of arms with six or seven joints.

An arm has one of three methods, which `choose_ik` selects by its geometry. Two are closed forms:

- spherical: [Brandstoetter2014]. Axis 2 is perpendicular to axis 1, and axis 3 parallel to axis 2.
  Axes 4, 5 and 6 meet in the wrist centre, and axis 5 is perpendicular to axes 4 and 6.
- parallel, as in arms of Universal Robots [Hawkins2013]. Axes 2, 3 and 4 are parallel and
  perpendicular to axis 1, and axis 5 is perpendicular to axes 4 and 6. Axes 5 and 6 meet in the
  wrist centre.

Every other arm has the numerical method of `robot.arm_ik_numerical`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from scipy.spatial.transform import Rotation

from planner_jax.robot.arm import Arm, joint_axes, link_frames, product, quaternion_rotation
from planner_jax.robot.arm_ik_numerical import search_poses

# The four branches of a closed form before its last choice of a sign, one a column. Row 0: 1 if the
# arm faces the wrist centre, -1 if it reaches over its shoulder. Row 1: 1 or -1 for the side of the
# elbow if the wrist is spherical, otherwise for the sign of the wrist's bend about axis 5.
_BRANCHES = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)]).T
# Rotations of the shield about its normal, +x, that closed forms try if this rotation is free.
_ROLLS = Rotation.from_rotvec(np.outer(0.5 * np.pi * np.arange(4), (1.0, 0.0, 0.0))).as_matrix()
_MISFIT = 1e-5  # [m] or [rad], largest deviation from the geometry that a closed form assumes


@struct.dataclass
class _Geometry:
    """Lengths and angles of an arm at joint angles 0.

    The coordinates x, y, z have their origin at joint 1; z is along axis 1 and y along axis 2. The
    forearm ends at the wrist centre if the wrist is spherical, otherwise at axis 4.
    """

    basis: Array  # (3, 3), columns are the directions of x, y, z in the base frame
    origin: Array  # (3,) [m], position of joint 1 in the base frame
    shoulder: Array  # (2,) [m], x and z of axis 2
    lateral: Array  # () [m], y of the wrist centre
    upper_arm: Array  # () [m], length from axis 2 to axis 3
    forearm: Array  # () [m], length from axis 3 to the forearm's end
    upper_arm_angle: Array  # () [rad] about y, from z to the upper arm
    forearm_angle: Array  # () [rad] about y, from z to the forearm
    hand: Array  # (2,) [m], x and z of the wrist centre relative to the forearm's end
    signs: Array  # (2,), of axes 3 and 4: 1 if an axis has the direction of axis 2, -1 if opposite
    wrist: Array  # (3,) [m], wrist centre in the frame of link 6
    before: Array  # (3, 3), columns axis 4, axis 5 and their cross product, in the basis
    after: Array  # (3, 3), columns axis 6, axis 5 and their cross product, in link 6's frame
    bend: Array  # () [rad], angle about axis 5 from axis 4 to axis 6


def _geometry(arm: Arm) -> _Geometry:
    rotations, positions = link_frames(arm, jnp.zeros(6, jnp.result_type(arm.origin)))
    axes = joint_axes(arm, rotations)
    basis = jnp.stack([jnp.cross(axes[1], axes[0]), axes[1], axes[0]], axis=1)
    origin = positions[0]
    centre = positions[4] + axes[4] * jnp.sum(axes[4] * (positions[5] - positions[4]))
    shoulder, elbow, end, wrist = (
        product(basis.T, place - origin)
        for place in (positions[1], positions[2], positions[3], centre)
    )
    end = wrist if arm.ik == "spherical" else end
    upper_arm, forearm = elbow - shoulder, end - elbow
    before = jnp.stack([axes[3], axes[4], jnp.cross(axes[3], axes[4])], axis=1)
    after = jnp.stack([axes[5], axes[4], jnp.cross(axes[5], axes[4])], axis=1)
    plane = jnp.array([0, 2])
    return _Geometry(
        basis=basis,
        origin=origin,
        shoulder=shoulder[plane],
        lateral=wrist[1],
        upper_arm=jnp.hypot(upper_arm[0], upper_arm[2]),
        forearm=jnp.hypot(forearm[0], forearm[2]),
        upper_arm_angle=jnp.arctan2(upper_arm[0], upper_arm[2]),
        forearm_angle=jnp.arctan2(forearm[0], forearm[2]),
        hand=(wrist - end)[plane],
        signs=jnp.sign(product(axes[2:4], axes[1])),
        wrist=product(rotations[5].T, centre - positions[5]),
        before=product(basis.T, before),
        after=product(rotations[5].T, after),
        bend=jnp.arctan2(-jnp.sum(axes[5] * before[:, 2]), jnp.sum(axes[5] * axes[3])),
    )


def inverse_kinematics(
    arm: Arm, rotation: Array, middle: Array, *, is_roll_free: bool = False
) -> tuple[Array, Array]:
    """Return K solutions for the joint angles that bring the shield to a pose.

    A closed form has K = 8 branches, 4 i + 2 j + k: i = 0 if the arm faces the wrist centre, 1 if
    it reaches over its shoulder; j and k are 0 or 1 for the side of the elbow and the sign of the
    wrist's bend about axis 5, k for the sign if the wrist is spherical, otherwise for the side. At
    a singularity, such as a straight wrist, where axes 4 and 6 are parallel, one joint angle is not
    determined. The joint with the lower number, or the sum of joints 2 to 4, is then set to zero.

    The numerical method has K = `arm_ik_numerical.STARTS` candidates from different starts.

    Args:
        arm: one arm, whose `ik` is the result of `choose_ik`.
        rotation: (3, 3), from shield to base frame; columns are the outward normal and the edges.
        middle: (3,) [m], middle of the shield's front face in the base frame.
        is_roll_free: whether the shield may be rotated about its normal. The numerical method then
            has one condition less. Closed forms try four rotations, K = 32, unless the last joint
            alone rotates the shield about its normal.

    Returns:
        angles: (K, n) [rad]. In closed forms each is shifted by multiples of 2 pi to be nearest to
            the middle of the joint's range. If the pose is out of reach, the arm is stretched
            towards it, or folded; values and gradients are finite.
        found: (K,) bool, whether the pose is reached and all joint angles are within their limits.
    """
    if arm.ik == "numerical":
        return search_poses(arm, rotation, middle, is_roll_free)
    if is_roll_free and not arm.turns_in_plane:
        rolled = product(rotation, jnp.asarray(_ROLLS, rotation.dtype))
        angles, found = jax.vmap(lambda each: _solve_branches(arm, each, middle))(rolled)
        return angles.reshape(-1, 6), found.reshape(-1)
    return _solve_branches(arm, rotation, middle)


def _solve_branches(arm: Arm, rotation: Array, middle: Array) -> tuple[Array, Array]:
    """Return the eight branches of a closed form; arguments as of `inverse_kinematics`."""
    geometry = _geometry(arm)
    shield = jnp.asarray(arm.shield_centre)
    rotation = product(rotation, quaternion_rotation(jnp.asarray(arm.shield_turn)).T)
    wrist = middle + product(rotation, geometry.wrist - shield) - geometry.origin
    wrist = product(geometry.basis.T, wrist)
    tip = product(product(geometry.basis.T, rotation), geometry.after)
    solve = _solve_spherical if arm.ik == "spherical" else _solve_parallel

    def branches(front: Array, sign: Array) -> tuple[Array, Array]:
        return solve(geometry, wrist, tip, front, sign)

    angles, reached = jax.vmap(branches)(*jnp.asarray(_BRANCHES, wrist.dtype))
    angles, reached = angles.reshape(8, 6), reached.reshape(8)
    lower, upper = jnp.asarray(arm.lower)[None], jnp.asarray(arm.upper)[None]
    angles = angles - 2.0 * jnp.pi * jnp.round((angles - 0.5 * (lower + upper)) / (2.0 * jnp.pi))
    return angles, reached & jnp.all((angles >= lower) & (angles <= upper), axis=1)


def _solve_spherical(
    geometry: _Geometry, wrist: Array, tip: Array, front: Array, elbow: Array
) -> tuple[Array, Array]:
    """Return two solutions (2, 6) [rad] for a spherical wrist, and whether they reach it, (2,)."""
    first, ahead, faces = _first_angle(geometry, wrist, front)
    second, third, reached = _elbow_angles(geometry, ahead, wrist[2], elbow)
    pitch = second + geometry.signs[0] * third
    turned = product(_turn_about(2, first), product(_turn_about(1, pitch), geometry.before))
    turn, bend = product(turned.T, tip), geometry.bend
    arm = jnp.stack([first, second, third])
    both = [jnp.append(arm, _wrist_angles(turn, flip, bend)) for flip in (1, -1)]
    return jnp.stack(both), jnp.stack([faces & reached] * 2)


def _solve_parallel(
    geometry: _Geometry, wrist: Array, tip: Array, front: Array, flip: Array
) -> tuple[Array, Array]:
    """Return two solutions (2, 6) [rad] for parallel axes 2 to 4, and whether they reach, (2,)."""
    first, ahead, faces = _first_angle(geometry, wrist, front)
    turn = product(product(_turn_about(2, first), geometry.before).T, tip)
    pitch, fifth, sixth = _wrist_angles(turn, flip, geometry.bend)
    pitch = geometry.signs[1] * pitch  # of the hand, about axis 2
    sin, cos = jnp.sin(pitch), jnp.cos(pitch)
    x, z = geometry.hand
    across, up = ahead - cos * x - sin * z, wrist[2] + sin * x - cos * z

    def solve(elbow: int) -> tuple[Array, Array]:
        second, third, reached = _elbow_angles(geometry, across, up, elbow)
        fourth = geometry.signs[1] * (pitch - second - geometry.signs[0] * third)
        return jnp.stack([first, second, third, fourth, fifth, sixth]), faces & reached

    angles, reached = zip(solve(1), solve(-1), strict=True)
    return jnp.stack(angles), jnp.stack(reached)


def _first_angle(geometry: _Geometry, wrist: Array, front: Array) -> tuple[Array, Array, Array]:
    """Return the angle of joint 1 [rad] for a wrist centre, and whether it exists.

    The second result is the wrist centre's coordinate x [m] after the rotation back by this angle.
    """
    x, y, _ = wrist
    # The slack allows for rounding errors at points to which the arm is fully stretched.
    slack = 16.0 * jnp.finfo(wrist.dtype).eps
    radius_squared = x * x + y * y
    ahead = front * _root(radius_squared - geometry.lateral**2)
    first = _angle(y, x) - _angle(geometry.lateral, ahead)
    return first, ahead, radius_squared >= geometry.lateral**2 * (1.0 - slack)


def _elbow_angles(
    geometry: _Geometry, x: Array, z: Array, elbow: Array | int
) -> tuple[Array, Array, Array]:
    """Return angles of joints 2 and 3 [rad] for a forearm's end at x, z, and whether it is reached.

    `elbow`, 1 or -1, is the side of the line from axis 2 to the forearm's end.
    """
    upper_arm, forearm = geometry.upper_arm, geometry.forearm
    slack = 16.0 * jnp.finfo(x.dtype).eps
    across, up = x - geometry.shoulder[0], z - geometry.shoulder[1]
    cosine = (across**2 + up**2 - upper_arm**2 - forearm**2) / (2.0 * upper_arm * forearm)
    reached = jnp.abs(cosine) <= 1.0 + slack
    cosine = jnp.clip(cosine, -1.0, 1.0)
    sine = elbow * _root((1.0 - cosine) * (1.0 + cosine))
    folded = _angle(forearm * sine, upper_arm + forearm * cosine)
    second = _angle(across, up) - folded - geometry.upper_arm_angle
    third = _angle(sine, cosine) - (geometry.forearm_angle - geometry.upper_arm_angle)
    return second, geometry.signs[0] * third, reached


def _wrist_angles(turn: Array, flip: Array | int, bend: Array) -> Array:
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


def choose_ik(arm: Arm) -> str:
    """Return the method of `inverse_kinematics` for an arm: spherical, parallel or numerical."""
    if arm.num != 6:
        return "numerical"
    rotation, position = Rotation.identity(), np.zeros(3)
    axes, positions = np.zeros((6, 3)), np.zeros((6, 3))
    for k in range(6):
        position = position + rotation.apply(arm.origin[k])
        rotation = rotation * Rotation.from_quat(arm.turn[k], scalar_first=True)
        axes[k], positions[k] = rotation.apply(arm.axis[k]), position
    centre = positions[4] + axes[4] * (axes[4] @ (positions[5] - positions[4]))

    def are_parallel(a: int, b: int) -> bool:
        return bool(np.linalg.norm(np.cross(axes[a], axes[b])) <= _MISFIT)

    def distance(a: int, place: np.ndarray) -> float:
        return float(np.linalg.norm(np.cross(axes[a], place - positions[a])))

    are_upright = all(abs(axes[a] @ axes[b]) <= _MISFIT for a, b in ((0, 1), (3, 4), (4, 5)))
    if not (are_upright and are_parallel(1, 2)) or distance(5, centre) > _MISFIT:
        return "numerical"
    if distance(1, positions[2]) <= _MISFIT:
        return "numerical"
    if distance(3, centre) <= _MISFIT < distance(2, centre):
        return "spherical"
    is_planar = are_parallel(1, 3) and distance(2, positions[3]) > _MISFIT
    return "parallel" if is_planar else "numerical"
