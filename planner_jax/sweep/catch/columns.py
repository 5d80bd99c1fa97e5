"""Columns of stored cases of catching: targets, order of catches, plan and referee's verdict.

A column of lists has one number, or three coordinates, for each target. Lists that belong to the
case are in the order of its targets, lists of plan and verdict in the order of the catches.
"""

import numpy as np
import pyarrow as pa

from planner_jax.runs import columns as known
from planner_jax.runs.columns import LIST, Column, leaves_of, list_of
from planner_jax.sweep.quadrotor import MOTION, START, TRAJECTORY
from planner_jax.task.catch.decide import optimal_time_ratio

FRAME = "world, z up; times from the start of planning"
_WHICH, _FLAGS = list_of(pa.int32()), list_of(pa.bool_())


def _time_ratio(batch: known.RefereedBatch) -> np.ndarray:
    return optimal_time_ratio(batch.cases, batch.plans)


COLUMNS = [
    known.INDEX,
    *leaves_of(
        "cases.targets",
        ("ball_pos", "m", "targets at time 0, N x 3", LIST, "ball.pos"),
        ("ball_vel", "m/s", "targets at time 0, N x 3", LIST, "ball.vel"),
        ("drag", "1/s", "linear, on each axis, N x 3", LIST, "drag"),
        ("ball_gravity", "m/s^2", "of the targets", LIST, "gravity"),
        ("swing_pos", "m", "middle of a swinging target at time 0, N x 3", LIST, "pos"),
        ("swing_vel", "m/s", "drift of a swinging target, N x 3", LIST, "vel"),
        ("swing_amplitude", "m", "of a swinging target, N x 3", LIST, "amplitude"),
        ("swing_rate", "rad/s", "of a swinging target", LIST, "rate"),
        ("swing_phase", "rad", "of a swinging target at time 0", LIST, "phase"),
        optional=True,
    ),
    *leaves_of(
        "cases",
        ("present", "", "whether each target exists", _FLAGS),
        ("horizon", "s", "latest time to catch each target", LIST),
    ),
    START,
    *leaves_of(
        "plans",
        ("order", "", "targets in the order of catching", _WHICH),
        ("decided_times", "s", "T_p, as decided", LIST),
        ("catch_times", "s", "T_o, as planned", LIST, "times"),
    ),
    Column("time_ratio", "1", "mean of |T_o - T_p| / T_o", known.NUMBER, _time_ratio),
    *known.SOLVER,
    *known.OUTCOME,
    *leaves_of(
        "verdict",
        ("caught", "", "whether each catch keeps its own limits", _FLAGS),
        ("num_caught", "", "of the targets", known.COUNT),
        ("net_distance", "m", "from the net's centre to the target at each catch", LIST),
        ("net_offset", "m", "component of this distance along the net's axis", LIST),
        ("angle", "rad", "between net's axis and reversed target velocity at each catch", LIST),
    ),
    *MOTION,
    *TRAJECTORY,
]
