"""Arms of other kinds than the shipped one, and their models for MuJoCo."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from planner_jax.robot.arm import Arm, ArmLimits
from planner_jax.robot.arm_ik import choose_ik

_HALF = np.sqrt(0.5)
_NO, _UP, _DOWN = (1.0, 0.0, 0.0, 0.0), (_HALF, _HALF, 0.0, 0.0), (_HALF, -_HALF, 0.0, 0.0)


def ur_like():
    """Return an arm with the lengths of a UR5e: axes 2, 3 and 4 are parallel, wrist offset."""
    origin = [(0, 0, 0.1625), (0, 0, 0), (0.425, 0, 0), (0.3922, 0, 0.1333), (0, 0, 0)]
    turn = [_NO, _UP, _NO, _NO, _DOWN, _UP]
    return arm_of([*origin, (0, 0.0996, 0.0997)], turn, -2.0 * np.pi, 2.0 * np.pi)


def askew_ur():
    """Return an arm of the same kind with more offsets, and other directions of axes 1 and 4."""
    origin = [(0.1, 0.2, 0.3), (0.05, 0.07, 0.1), (0.4, 0.1, 0.02), (0.1, -0.35, 0.13)]
    turn = [(0.5, 0.1, -0.7, 0.5), _UP, _NO, (0.0, 1.0, 0.0, 0.0), _DOWN, _UP]
    turn = Rotation.from_quat(turn, scalar_first=True)
    turn *= Rotation.from_rotvec(np.outer([0.3, -0.8, 0.5, 1.0, -0.4, 2.0], (0.0, 0.0, 1.0)))
    turn = turn.as_quat(scalar_first=True)
    return arm_of([*origin, (0.03, 0.04, 0.05), (0, 0.0996, 0.08)], turn, -2.5, 2.8)


def offset_wrist():
    """Return an arm with six joints whose last three axes do not meet, as in cobots of FANUC."""
    origin = [(0, 0, 0.245), (0, 0, 0), (0.54, 0, 0), (0.05, -0.54, 0), (0, -0.15, 0), (0, 0.16, 0)]
    turn = [_NO, _UP, _NO, _UP, _DOWN, _UP]
    upper = np.array([3.1, 2.6, 3.0, 3.3, 3.0, 3.9])
    return arm_of(origin, turn, -upper, upper)


def seven_joints():
    """Return an arm with the lengths and limits of a Panda: seven joints, offsets at the elbow."""
    origin = [(0, 0, 0.333), (0, 0, 0), (0, -0.316, 0), (0.0825, 0, 0), (-0.0825, 0.384, 0)]
    turn = [_NO, _DOWN, _UP, _UP, _DOWN, _UP, _UP]
    upper = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    lower = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
    return arm_of([*origin, (0, 0, 0), (0.088, 0, 0)], turn, lower, upper)


def arm_of(origin, turn, lower, upper):
    """Return an arm without capsules whose joints turn about z, with links of 1 kg, in float64."""
    num = len(origin)
    lower, upper = (np.broadcast_to(np.array(each, float), num) for each in (lower, upper))
    arm = Arm(
        origin=np.array(origin, float),
        turn=np.array(turn),
        axis=np.tile((0.0, 0.0, 1.0), (num, 1)),
        lower=lower,
        upper=upper,
        home=0.5 * (lower + upper),
        limits=ArmLimits(np.full(num, 3.0), np.full(num, 20.0)),
        mass=np.ones(num),
        centre=np.zeros((num, 3)),
        inertia=np.tile(1e-2 * np.eye(3), (num, 1, 1)),
        capsule_ends=np.zeros((0, 2, 3)),
        capsule_radius=np.zeros(0),
        shield_gap_radius=np.zeros(0),
        base_box=np.zeros((2, 3)),
        shield_centre=np.array((0.05, 0.02, 0.1)),
        shield_turn=np.array((0.1, 0.7, -0.1, 0.7)),
        shield_half=np.array((0.15, 0.15)),
        shield_corners=0.15 * np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)]),
        capsule_link=(),
        pairs=(),
        shield_pairs=(),
        base_pairs=(),
        joint_names=tuple(f"joint_{k}" for k in range(1, num + 1)),
        turns_in_plane=False,
    )
    return dataclasses.replace(arm, ik=choose_ik(arm))


def mjcf_of(arm):
    """Return the arm as a model for MuJoCo, with a site named shield at the shield's middle."""
    text = lambda values: " ".join(map(repr, np.asarray(values).tolist()))  # noqa: E731
    site = f'<site name="shield" pos="{text(arm.shield_centre)}" quat="{text(arm.shield_turn)}"/>'
    for k in reversed(range(arm.num)):
        mass = f'<inertial mass="1" pos="{text(arm.centre[k])}" diaginertia="0.01 0.01 0.01"/>'
        joint = f'<joint axis="{text(arm.axis[k])}"/>'
        frame = f'pos="{text(arm.origin[k])}" quat="{text(arm.turn[k])}"'
        site = f"<body {frame}>{joint}{mass}{site}</body>"
    return f"<mujoco><worldbody>{site}</worldbody></mujoco>"


KINDS = {
    "ur": ur_like(),
    "askew ur": askew_ur(),
    "offset wrist": offset_wrist(),
    "seven joints": seven_joints(),
}
