"""Export of plans as MCAP files of ROS 2 messages, with times since the start of the plan."""

from typing import BinaryIO

import numpy as np
from mcap_ros2.writer import Writer

from planner_jax.core.protocol import Plan
from planner_jax.export import px4, ros2
from planner_jax.export.setpoints import Joints
from planner_jax.robot.quadrotor import QuadrotorPlan

SETPOINT, SETPOINT_TOPIC = "px4_msgs/TrajectorySetpoint", "/fmu/in/trajectory_setpoint"
_TYPES = {
    **ros2.TYPES,
    SETPOINT: "uint64 timestamp\nfloat32[3] position\nfloat32[3] velocity\n"
    "float32[3] acceleration\nfloat32[3] jerk\nfloat32 yaw\nfloat32 yawspeed",
}


def write_trajectory(plan: Plan, rate: float, file: BinaryIO, joints: Joints | None = None) -> None:
    """Write a plan as one message of ROS's `trajectory_msgs`, with setpoints at `rate` [Hz]."""
    kind, fields = ros2.trajectory(plan, rate, joints)
    with Writer(file) as writer:
        schema = writer.register_msgdef(_full_name(kind), _definition(kind))
        writer.write_message(ros2.TOPICS[kind], schema, fields, log_time=0)


def write_setpoints(plan: QuadrotorPlan, rate: float, file: BinaryIO) -> None:
    """Write a plan as messages `px4_msgs/TrajectorySetpoint`, one for each setpoint."""
    fields = px4.trajectory_setpoints(plan, rate)
    with Writer(file) as writer:
        schema = writer.register_msgdef(_full_name(SETPOINT), _definition(SETPOINT))
        for k, row in enumerate(zip(*map(np.ndarray.tolist, fields.values()), strict=True)):
            message = dict(zip(fields, row, strict=True))
            stamp = 1000 * message["timestamp"]
            writer.write_message(SETPOINT_TOPIC, schema, message, log_time=stamp, sequence=k)


def _full_name(kind: str) -> str:
    return kind.replace("/", "/msg/")


def _definition(kind: str) -> str:
    types = [kind]
    for each in types:  # the loop also visits the types that it appends
        inner = (line.split()[0].removesuffix("[]") for line in _TYPES[each].splitlines())
        types += [name for name in dict.fromkeys(inner) if name in _TYPES and name not in types]
    parts = [_TYPES[kind], *(f"MSG: {each}\n{_TYPES[each]}" for each in types[1:])]
    return ("\n" + 80 * "=" + "\n").join(parts) + "\n"
