"""Plans as ROS 2 has them: one message of `trajectory_msgs` with all setpoints.

World frame ENU and body frame FLU, REP 103, as ours: x, y, z stay what they are. A quadrotor or a
car is one joint of six degrees of freedom, whose velocities, turning included, are in the world
frame; an arm has its joints.
"""

import pkgutil
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from planner_jax.core.errors import MissingExtra
from planner_jax.core.protocol import Plan
from planner_jax.export.frames import rotated
from planner_jax.export.setpoints import DEFAULT_RATE, Setpoints, setpoints_of
from planner_jax.robot.arm import ArmSetpoints
from planner_jax.robot.quadrotor import QuadrotorSetpoints

Json = Any  # plain values, lists and dictionaries
WORLD, BODY = "world", "base_link"
JOINTS = [f"joint_{k}" for k in range(1, 7)]  # as the ROS packages of the arm's maker have them
BODIES, ARM = "trajectory_msgs/MultiDOFJointTrajectory", "trajectory_msgs/JointTrajectory"
TOPICS = {BODIES: "/command/trajectory", ARM: "/joint_trajectory_controller/joint_trajectory"}
# Fields of every type that the two consist of.
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
_NOW = {"sec": 0, "nanosec": 0}  # controllers begin with a trajectory of this stamp at once


def trajectory_message(plan: Plan, rate: float = DEFAULT_RATE) -> object:
    """Convert a plan to an object of ROS 2's own class, to be published.

    Args:
        plan: one, solved; of a quadrotor, a car or an arm.
        rate: [Hz].

    Returns:
        `trajectory_msgs.msg.MultiDOFJointTrajectory` of a quadrotor or a car, and
        `trajectory_msgs.msg.JointTrajectory` of an arm.

    Raises:
        ArgumentError: the plan cannot be exported, or the rate is absurd.
        MissingExtra: this Python has no ROS 2.
    """
    kind, fields = trajectory(plan, rate)
    try:
        return _as_ros(kind, fields)
    except ModuleNotFoundError as error:
        missing = MissingExtra("trajectory_message", f"{error.name} of ROS 2", "export")
        missing.install = "source its setup file first"
        raise missing from None


def trajectory(plan: Plan, rate: float) -> tuple[str, dict[str, Json]]:
    """Return the type of the message, a key of `TYPES`, and its fields as plain values."""
    found = setpoints_of(plan, rate)
    nanoseconds = np.round(found.time * 1e9).astype(int).tolist()
    times = [dict(zip(("sec", "nanosec"), divmod(t, 10**9), strict=True)) for t in nanoseconds]
    if isinstance(found, ArmSetpoints):
        rows = zip(*(a.tolist() for a in _joints(found)), times, strict=True)
        points = [
            dict(positions=q, velocities=v, accelerations=a, effort=[], time_from_start=time)
            for q, v, a, time in rows
        ]
        return ARM, _trajectory(JOINTS, points)
    rows = zip(*(a.tolist() for a in _motion(found)), times, strict=True)
    points = [
        {
            "transforms": [{"translation": _vector(pos), "rotation": _vector(quat)}],
            "velocities": [{"linear": _vector(vel), "angular": _vector(spin)}],
            "accelerations": [{"linear": _vector(acc), "angular": _vector((0.0, 0.0, 0.0))}],
            "time_from_start": time,
        }
        for pos, quat, vel, spin, acc, time in rows
    ]
    return BODIES, _trajectory([BODY], points)


def _trajectory(joints: list[str], points: list[dict[str, Json]]) -> dict[str, Json]:
    return {"header": {"stamp": _NOW, "frame_id": WORLD}, "joint_names": joints, "points": points}


def _joints(found: ArmSetpoints) -> tuple[np.ndarray, ...]:
    return found.angles, found.rates, found.accelerations


def _motion(found: Setpoints) -> tuple[np.ndarray, ...]:
    """Return position, quaternion x, y, z, w, velocity, body rate and acceleration in the world.

    Setpoints do not hold angular accelerations.
    """
    if isinstance(found, QuadrotorSetpoints):
        xyzw = np.roll(found.quat_wxyz, -1, axis=1)
        return found.pos, xyzw, found.vel, rotated(found.quat_wxyz, found.body_rate), found.acc
    assert not isinstance(found, ArmSetpoints)
    heading = found.heading.astype(float)
    nought = np.zeros_like(heading)
    ahead = np.stack([np.cos(heading), np.sin(heading), nought], axis=1)
    aside = np.stack([-np.sin(heading), np.cos(heading), nought], axis=1)
    inward = found.speed * found.yaw_rate
    return (
        np.stack([*found.pos.T, nought], axis=1),
        np.stack([nought, nought, np.sin(0.5 * heading), np.cos(0.5 * heading)], axis=1),
        found.speed[:, None] * ahead,
        np.stack([nought, nought, found.yaw_rate], axis=1),
        found.acceleration[:, None] * ahead + inward[:, None] * aside,
    )


def _vector(values: Sequence[float]) -> dict[str, float]:
    """Name the components of a vector or a quaternion."""
    return dict(zip("xyzw"[: len(values)], values, strict=True))


def _as_ros(kind: str, fields: Mapping[str, Json]) -> object:
    """Make an object of the class of a ROS 2 type, with all fields set."""
    package, name = kind.split("/")
    message = pkgutil.resolve_name(f"{package}.msg:{name}")()
    for line in TYPES[kind].splitlines():
        inner, field = line.split()
        value, of_one = fields[field], inner.removesuffix("[]")
        if of_one in TYPES:
            value = (
                _as_ros(inner, value)
                if of_one == inner
                else [_as_ros(of_one, each) for each in value]
            )
        setattr(message, field, value)
    return message
