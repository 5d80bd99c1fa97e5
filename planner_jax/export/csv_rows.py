"""Export of setpoints as CSV: a header with names and units, and one row for each time."""

from typing import BinaryIO

import numpy as np

from planner_jax.core.protocol import Plan
from planner_jax.export.setpoints import robot_of, setpoints_of

_AXES, _JOINTS = ("x", "y", "z"), ("1", "2", "3", "4", "5", "6")
# For each robot, the columns of its table. An entry is a field of the setpoints, the names of the
# columns with the field's components, and the unit.
_COLUMNS: dict[str, list[tuple[str, list[str], str]]] = {
    "quadrotor": [
        ("time", ["time"], "s"),
        ("pos", [*_AXES], "m"),
        ("vel", [f"v{axis}" for axis in _AXES], "m/s"),
        ("acc", [f"a{axis}" for axis in _AXES], "m/s^2"),
        ("jerk", [f"j{axis}" for axis in _AXES], "m/s^3"),
        ("quat_wxyz", ["qw", "qx", "qy", "qz"], "1"),
        ("body_rate", [f"w{axis}" for axis in _AXES], "rad/s"),
        ("thrust", ["thrust"], "m/s^2"),
    ],
    "car": [
        ("time", ["time"], "s"),
        ("pos", ["x", "y"], "m"),
        ("heading", ["heading"], "rad"),
        ("speed", ["speed"], "m/s"),
        ("acceleration", ["acceleration"], "m/s^2"),
        ("curvature", ["curvature"], "1/m"),
        ("yaw_rate", ["yaw_rate"], "rad/s"),
    ],
    "arm": [
        ("time", ["time"], "s"),
        ("angles", [f"q{joint}" for joint in _JOINTS], "rad"),
        ("rates", [f"dq{joint}" for joint in _JOINTS], "rad/s"),
        ("accelerations", [f"ddq{joint}" for joint in _JOINTS], "rad/s^2"),
    ],
}


def write(plan: Plan, rate: float, file: BinaryIO) -> None:
    """Write the setpoints of a plan at `rate` [Hz], in SI units and the frames ENU and FLU."""
    columns = _COLUMNS[robot_of(plan).name]
    setpoints = setpoints_of(plan, rate)
    header = [f"{name} [{unit}]" for _, names, unit in columns for name in names]
    write_table(file, header, [vars(setpoints)[field] for field, _, _ in columns])


def write_table(file: BinaryIO, header: list[str], columns: list[np.ndarray]) -> None:
    """Write a header line and rows as CSV; an array of two axes in `columns` is several columns."""
    file.write((",".join(header) + "\n").encode())
    blocks = [np.asarray(column).reshape(len(column), -1) for column in columns]
    for parts in zip(*blocks, strict=True):
        file.write((",".join(str(value) for part in parts for value in part) + "\n").encode())
