"""Export of setpoints as CSV: a header with names and units, and one row for each time."""

from collections.abc import Sequence
from typing import BinaryIO

import numpy as np

from planner_jax.core.protocol import Plan
from planner_jax.export.setpoints import Joints, robot_of, setpoints_of

# For each robot, the columns of its table. An entry is a field of the setpoints, the names of the
# columns with the field's components, and the unit. A name with # is repeated for each joint.
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
        ("angles", "q#", "rad"),
        ("rates", "dq#", "rad/s"),
        ("accelerations", "ddq#", "rad/s^2"),
    ],
}


def write(plan: Plan, rate: float, file: BinaryIO, joints: Joints | None = None) -> None:
    """Write setpoints at `rate` [Hz] in SI units, in world frame ENU and body frame FLU.

    Names and limits of an arm's `joints` are comment lines below the header.
    """
    setpoints = vars(setpoints_of(plan, rate))
    columns, header = [], []
    for field, names, unit in _COLUMNS[robot_of(plan).name]:
        values = setpoints[field]
        columns.append(values)
        every = [names.replace("#", str(k)) for k in range(1, values.shape[-1] + 1)]
        header += [f"{name} [{unit}]" for name in (every if "#" in names else names.split())]
    write_table(file, header, columns, joints.lines if joints else ())


def write_table(
    file: BinaryIO, header: list[str], columns: list[np.ndarray], comments: Sequence[str] = ()
) -> None:
    """Write a header line, comment lines after "#", and rows as CSV.

    An array of two axes in `columns` is several columns.
    """
    file.write((",".join(header) + "\n").encode())
    file.write("".join(f"# {line}\n" for line in comments).encode())
    blocks = [np.asarray(column).reshape(len(column), -1) for column in columns]
    for parts in zip(*blocks, strict=True):
        file.write((",".join(str(value) for part in parts for value in part) + "\n").encode())
