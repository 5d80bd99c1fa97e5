"""Export of plans for ROS 2: one message of the package `trajectory_msgs` with all setpoints.

World frame ENU and body frame FLU (REP 103). A quadrotor or a car is one joint with six degrees of
freedom, whose velocities are in the world frame. The message of an arm is a goal that the
controller `joint_trajectory_controller` accepts: it ends at standstill, and its times rise.
"""

import pkgutil
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import PyTree

from planner_jax.core.missing_extra import MissingExtra
from planner_jax.core.protocol import Plan
from planner_jax.export.frames import rotate
from planner_jax.export.setpoints import DEFAULT_RATE, Joints, joints_of, setpoints_of
from planner_jax.recovery.after_plan import is_rested
from planner_jax.robot.arm import ArmPlan, ArmSetpoints
from planner_jax.robot.attitude import QuadrotorSetpoints
from planner_jax.robot.car import CarSetpoints

Json = Any  # plain numbers and texts, lists and dictionaries
WORLD, BODY = "world", "base_link"
BODIES, ARM = "trajectory_msgs/MultiDOFJointTrajectory", "trajectory_msgs/JointTrajectory"
TOPICS = {BODIES: "/command/trajectory", ARM: "/joint_trajectory_controller/joint_trajectory"}
# For each ROS message type, and for the types of its fields: the types and names of the fields.
TYPES = {
    BODIES: "std_msgs/Header header\nstring[] joint_names\n"
    "trajectory_msgs/MultiDOFJointTrajectoryPoint[] points",
    "trajectory_msgs/MultiDOFJointTrajectoryPoint": "geometry_msgs/Transform[] transforms\n"
    "geometry_msgs/Twist[] velocities\ngeometry_msgs/Twist[] accelerations\n"
    "builtin_interfaces/Duration time_from_start",
    ARM: "std_msgs/Header header\nstring[] joint_names\n"
    "trajectory_msgs/JointTrajectoryPoint[] points",
    "trajectory_msgs/JointTrajectoryPoint": "float64[] positions\nfloat64[] velocities\n"
    "float64[] accelerations\nfloat64[] effort\nbuiltin_interfaces/Duration time_from_start",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\n"
    "geometry_msgs/Quaternion rotation",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
}
_NOW = {"sec": 0, "nanosec": 0}  # time stamp for which controllers start a trajectory at once


def trajectory_message(
    plan: Plan,
    rate: float = DEFAULT_RATE,
    *,
    joint_names: Sequence[str] | None = None,
    case: PyTree | None = None,
) -> object:
    """Convert a plan to an object of ROS 2's own class, which can be published.

    Args:
        plan: one solved plan of a quadrotor, a car or an arm.
        rate: [Hz], setpoints per second.
        joint_names: names of an arm's joints, by default the names in the file of the case's arm.
        case: case of an arm's plan.

    Returns:
        `trajectory_msgs.msg.MultiDOFJointTrajectory` for a quadrotor or a car,
        `trajectory_msgs.msg.JointTrajectory` for an arm.

    Raises:
        ArgumentError: the plan cannot be exported, or the rate is out of its range.
        MissingExtra: ROS 2 is not installed for this Python.
    """
    joints = joints_of(plan, joint_names, case) if isinstance(plan, ArmPlan) else None
    kind, fields = trajectory(plan, rate, joints)
    try:
        return _make_message(kind, fields)
    except ModuleNotFoundError as error:
        missing = MissingExtra("trajectory_message", f"{error.name} of ROS 2", "export")
        missing.install = "source its setup file first"
        raise missing from None


def trajectory(
    plan: Plan, rate: float, joints: Joints | None = None
) -> tuple[str, dict[str, Json]]:
    """Convert a plan to a ROS message; return its type, a key of `TYPES`, and its fields."""
    setpoints = setpoints_of(plan, rate)
    nanoseconds = np.round(setpoints.time * 1e9).astype(int).tolist()
    times = [dict(zip(("sec", "nanosec"), divmod(t, 10**9), strict=True)) for t in nanoseconds]
    if isinstance(plan, ArmPlan) and isinstance(setpoints, ArmSetpoints):
        if not is_rested(plan):
            rate = np.abs(setpoints.rates[-1]).max()
            warnings.warn(
                f"the plan ends at {rate:.2g} rad/s, which joint_trajectory_controller rejects "
                "by default; the recovery 'brake' continues it to standstill",
                stacklevel=2,
            )
        kind, names = ARM, (joints or joints_of(plan)).names
        columns = (setpoints.angles, setpoints.rates, setpoints.accelerations)
        rows = zip(*(column.tolist() for column in columns), times, strict=True)
        points = [
            dict(positions=q, velocities=v, accelerations=a, effort=[], time_from_start=time)
            for q, v, a, time in rows
        ]
    else:
        assert not isinstance(setpoints, ArmSetpoints)
        kind, names = BODIES, (BODY,)
        rows = zip(*(column.tolist() for column in _motion(setpoints)), times, strict=True)
        points = [
            {
                "transforms": [{"translation": _vector(pos), "rotation": _vector(quat)}],
                "velocities": [{"linear": _vector(vel), "angular": _vector(spin)}],
                "accelerations": [{"linear": _vector(acc), "angular": _vector((0.0, 0.0, 0.0))}],
                "time_from_start": time,
            }
            for pos, quat, vel, spin, acc, time in rows
        ]
    header = {"stamp": _NOW, "frame_id": WORLD}
    return kind, {"header": header, "joint_names": list(names), "points": points}


def _motion(setpoints: QuadrotorSetpoints | CarSetpoints) -> tuple[np.ndarray, ...]:
    """Return position, quaternion (x, y, z, w), velocity, angular velocity, acceleration (ENU)."""
    if isinstance(setpoints, QuadrotorSetpoints):
        quat = setpoints.quat_wxyz
        spin = rotate(quat, setpoints.body_rate)
        return setpoints.pos, np.roll(quat, -1, axis=1), setpoints.vel, spin, setpoints.acc
    heading = setpoints.heading.astype(float)
    nought = np.zeros_like(heading)
    ahead = np.stack([np.cos(heading), np.sin(heading), nought], axis=1)
    aside = np.stack([-np.sin(heading), np.cos(heading), nought], axis=1)
    inward = setpoints.speed * setpoints.yaw_rate
    return (
        np.stack([*setpoints.pos.T, nought], axis=1),
        np.stack([nought, nought, np.sin(0.5 * heading), np.cos(0.5 * heading)], axis=1),
        setpoints.speed[:, None] * ahead,
        np.stack([nought, nought, setpoints.yaw_rate], axis=1),
        setpoints.acceleration[:, None] * ahead + inward[:, None] * aside,
    )


def _vector(values: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyzw"[: len(values)], values, strict=True))


def _make_message(kind: str, fields: Mapping[str, Json]) -> object:
    package, name = kind.split("/")
    message = pkgutil.resolve_name(f"{package}.msg:{name}")()
    for line in TYPES[kind].splitlines():
        inner, field = line.split()
        value, element = fields[field], inner.removesuffix("[]")
        if inner in TYPES:
            value = _make_message(inner, value)
        elif element in TYPES:
            value = [_make_message(element, each) for each in value]
        setattr(message, field, value)
    return message
