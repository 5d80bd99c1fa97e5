"""Columns of a catch run: targets, decision, catches and verdict.

For N targets, a list of a row has N entries, or N points in sequence. Lists of the decision, the
plan and the verdict are in the order of catching.
"""

import numpy as np
import pyarrow as pa

from planner_jax.runs import columns as known
from planner_jax.runs.columns import LIST, Column, leaves_of, list_of
from planner_jax.sweep.quadrotor import MOTION, START, TRAJECTORY
from planner_jax.task.catch.decide import optimal_time_ratio

FRAME = "world, z up; times from the start of planning"
_WHICH, _FLAGS = list_of(pa.int32()), list_of(pa.bool_())


def _target(name: str, unit: str, meaning: str, path: str) -> Column:
    """Return the column of a leaf of the targets; null if their class does not have it."""

    def values(batch: known.RefereedBatch) -> known.Values:
        leaf = batch.cases.targets
        for step in path.split("."):
            leaf = None if leaf is None else vars(leaf).get(step)
        return leaf

    return Column(name, unit, meaning, LIST, values)


def _time_ratio(batch: known.RefereedBatch) -> np.ndarray:
    return optimal_time_ratio(batch.cases, batch.plans)


COLUMNS = [
    known.INDEX,
    _target("ball_pos", "m", "targets at time 0, N x 3", "ball.pos"),
    _target("ball_vel", "m/s", "targets at time 0, N x 3", "ball.vel"),
    _target("drag", "1/s", "linear, on each axis, N x 3", "drag"),
    _target("ball_gravity", "m/s^2", "of the targets", "gravity"),
    _target("swing_pos", "m", "middle of a swinging target at time 0, N x 3", "pos"),
    _target("swing_vel", "m/s", "drift of a swinging target, N x 3", "vel"),
    _target("swing_amplitude", "m", "of a swinging target, N x 3", "amplitude"),
    _target("swing_rate", "rad/s", "of a swinging target", "rate"),
    _target("swing_phase", "rad", "of a swinging target at time 0", "phase"),
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
        (
            "angle",
            "rad",
            "between net's axis and reversed target velocity at each catch",
            LIST,
        ),
    ),
    *MOTION,
    *TRAJECTORY,
]
