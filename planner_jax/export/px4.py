"""Export of setpoints for the autopilot PX4: its message TrajectorySetpoint, in the frame NED."""

from typing import BinaryIO

import numpy as np

from planner_jax.export.csv_rows import write_table
from planner_jax.export.frames import to_ned, to_ned_yaw, yaw_of
from planner_jax.export.setpoints import require_near, setpoints_of
from planner_jax.robot.attitude import QuadrotorSetpoints
from planner_jax.robot.quadrotor import QuadrotorPlan

_VECTORS = ("position", "velocity", "acceleration", "jerk")


def trajectory_setpoints(plan: QuadrotorPlan, rate: float) -> dict[str, np.ndarray]:
    """Return the fields of messages `px4_msgs/TrajectorySetpoint` by name, in the local NED frame.

    Args:
        plan: one solved plan.
        rate: [Hz], setpoints per second.

    Returns:
        timestamp: (K,) uint64 [us], times of the K setpoints since the start of the plan.
        position, velocity, acceleration, jerk: (K, 3) float32 [m], [m/s], [m/s^2], [m/s^3]. The
            acceleration is without gravity, which PX4 adds itself.
        yaw: (K,) float32 [rad], yaw of the attitude, clockwise from north, in [-pi, pi].
        yawspeed: (K,) float32 [rad/s], rate of the yaw.
    """
    points = setpoints_of(plan, rate)
    assert isinstance(points, QuadrotorSetpoints)
    require_near(points.pos)
    yaw, yaw_rate = yaw_of(points.quat_wxyz, points.body_rate)
    vectors = zip(_VECTORS, (points.pos, points.vel, points.acc, points.jerk), strict=True)
    return {
        "timestamp": np.round(points.time * 1e6).astype(np.uint64),
        **{name: to_ned(np.asarray(vector, np.float32)) for name, vector in vectors},
        "yaw": to_ned_yaw(yaw).astype(np.float32),
        "yawspeed": (-yaw_rate).astype(np.float32),
    }


def write_csv(plan: QuadrotorPlan, rate: float, file: BinaryIO) -> None:
    """Write a plan's TrajectorySetpoint messages as CSV rows, with PX4's names of the columns."""
    fields = trajectory_setpoints(plan, rate)
    header = [
        f"{name}[{axis}]" if values.ndim == 2 else name
        for name, values in fields.items()
        for axis in range(values[0].size)
    ]
    write_table(file, header, list(fields.values()))
