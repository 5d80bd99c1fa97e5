"""Export of an arm's plan as a program in URScript, the language of Universal Robots."""

from typing import BinaryIO

import numpy as np

from planner_jax.core.choices import require
from planner_jax.export.setpoints import Joints, joints_of, setpoints_of
from planner_jax.robot.arm import ArmPlan, ArmSetpoints

_HEAD = """\
  lookahead_time = 0.03  # [s], from 0.03 to 0.2; a longer time gives a smoother, later motion
  gain = 300  # from 100 to 2000; a higher gain follows more closely
"""


def write(plan: ArmPlan, rate: float, file: BinaryIO, joints: Joints | None = None) -> None:
    """Write a function that moves the arm to the plan's start, and then along its setpoints.

    Each `servoj` lasts until the time of its setpoint. The arm then brakes by `stopj`.

    Raises:
        ArgumentError: the arm does not have six joints.
    """
    joints = joints or joints_of(plan)
    num = len(joints.names)
    require(num == 6, "plan", "of an arm with 6 joints for URScript", shown=f"{num} joints")
    points = setpoints_of(plan, rate)
    assert isinstance(points, ArmSetpoints)
    start, *poses = (f"[{', '.join(f'{q:.7g}' for q in pose)}]" for pose in points.angles.tolist())
    rows = zip(poses, np.diff(points.time).tolist(), strict=True)
    lines = [f"  # {line}" for line in joints.lines]
    lines += [f"  movej({start}, a=1.4, v=1.05)  # to the start of the plan"]
    lines += [f"  servoj({pose}, 0, 0, {step:.6g}, lookahead_time, gain)" for pose, step in rows]
    body = "\n".join(lines)
    file.write(f"def planned_motion():\n{_HEAD}{body}\n  stopj(2.0)\nend\n".encode())
