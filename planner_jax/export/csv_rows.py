"""Export of setpoints as CSV: a header with names and units, and one row for each time."""

from typing import BinaryIO

import numpy as np

from planner_jax.core.protocol import Plan
from planner_jax.export.setpoints import robot_of, setpoints_of

# For each robot, the columns of its table. An entry is a field of the setpoints, the names of the
# columns with the field's components, and the unit.
_COLUMNS = {
    "quadrotor": [
        ("time", "time", "s"),
        ("pos", "x y z", "m"),
        ("vel", "vx vy vz", "m/s"),
        ("acc", "ax ay az", "m/s^2"),
        ("jerk", "jx jy jz", "m/s^3"),
        ("quat_wxyz", "qw qx qy qz", "1"),
        ("body_rate", "wx wy wz", "rad/s"),
        ("thrust", "thrust", "m/s^2"),
    ],
    "car": [
        ("time", "time", "s"),
        ("pos", "x y", "m"),
        ("heading", "heading", "rad"),
        ("speed", "speed", "m/s"),
        ("acceleration", "acceleration", "m/s^2"),
        ("curvature", "curvature", "1/m"),
        ("yaw_rate", "yaw_rate", "rad/s"),
    ],
    "arm": [
        ("time", "time", "s"),
        ("angles", "q1 q2 q3 q4 q5 q6", "rad"),
        ("rates", "dq1 dq2 dq3 dq4 dq5 dq6", "rad/s"),
        ("accelerations", "ddq1 ddq2 ddq3 ddq4 ddq5 ddq6", "rad/s^2"),
    ],
}


def write(plan: Plan, rate: float, file: BinaryIO) -> None:
    """Write setpoints at `rate` [Hz] in SI units, in world frame ENU and body frame FLU."""
    columns = _COLUMNS[robot_of(plan).name]
    setpoints = setpoints_of(plan, rate)
    header = [f"{name} [{unit}]" for _, names, unit in columns for name in names.split()]
    write_table(file, header, [vars(setpoints)[field] for field, _, _ in columns])


def write_table(file: BinaryIO, header: list[str], columns: list[np.ndarray]) -> None:
    """Write a header line and rows as CSV; an array of two axes in `columns` is several columns."""
    file.write((",".join(header) + "\n").encode())
    blocks = [np.asarray(column).reshape(len(column), -1) for column in columns]
    for parts in zip(*blocks, strict=True):
        file.write((",".join(str(value) for part in parts for value in part) + "\n").encode())
