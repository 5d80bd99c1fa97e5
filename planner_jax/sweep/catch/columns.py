"""The columns of a catch run: targets, decision, catches and verdict.

N targets, so that lists of a row have N entries, or N points one behind the other. Those of
the decision, the plan and the verdict are in the order of catching.
"""

from collections.abc import Sequence
from typing import Any

import pyarrow as pa

from planner_jax.sweep.columns import (
    COUNT,
    INDEX,
    LIST,
    NUMBER,
    OUTCOME,
    SOLVER,
    Column,
    RefereedBatch,
    leaves_of,
    list_of,
)
from planner_jax.sweep.quadrotor import MOTION, START, TRAJECTORY
from planner_jax.task.catch.decide import optimal_time_ratio

_WHICH, _FLAGS = list_of(pa.int32()), list_of(pa.bool_())


def _of_targets(*names: str) -> Any:
    """Leaf of the targets at a path; null for targets of a class without it."""

    def values(batch: RefereedBatch) -> Any:
        leaf = batch.cases.targets
        for name in names:
            leaf = getattr(leaf, name, None)
        return leaf

    return values


def _targets(rows: Sequence[tuple[str, str, str, str]]) -> list[Column]:
    """Columns of the leaves of target paths: name, unit, meaning, dotted path."""
    return [
        Column(name, unit, meaning, LIST, _of_targets(*path.split(".")))
        for name, unit, meaning, path in rows
    ]


_CASE = [
    INDEX,
    *_targets(
        [
            ("ball_pos", "m", "targets at time 0, N x 3", "ball.pos"),
            ("ball_vel", "m/s", "targets at time 0, N x 3", "ball.vel"),
            ("drag", "1/s", "linear, on each axis, N x 3", "drag"),
            ("ball_gravity", "m/s^2", "of the targets", "gravity"),
            ("swing_pos", "m", "middle of a swinging target at time 0, N x 3", "pos"),
            ("swing_vel", "m/s", "drift of a swinging target, N x 3", "vel"),
            ("swing_amplitude", "m", "of a swinging target, N x 3", "amplitude"),
            ("swing_rate", "rad/s", "of a swinging target", "rate"),
            ("swing_phase", "rad", "of a swinging target at time 0", "phase"),
        ]
    ),
    *leaves_of(
        "cases",
        [
            ("present", "", "which of the targets there are", _FLAGS, ""),
            ("horizon", "s", "until when each target may be caught", LIST, ""),
        ],
    ),
]

_CATCHES = [
    *leaves_of("plans", [("order", "", "targets in the order of catching", _WHICH, "")]),
    *leaves_of(
        "plans",
        [
            ("decided_times", "s", "T_p, as decided", LIST, ""),
            ("catch_times", "s", "T_o, as planned", LIST, "times"),
        ],
    ),
    Column(
        "time_ratio",
        "1",
        "mean of |T_o - T_p| / T_o",
        NUMBER,
        lambda b: optimal_time_ratio(b.cases, b.plans),
    ),
]

_JUDGED = leaves_of(
    "verdict",
    [
        ("caught", "", "whether each catch holds, the way there aside", _FLAGS, ""),
        ("num_caught", "", "of the targets", COUNT, ""),
        ("net_distance", "m", "net's centre to target at each catch", LIST, ""),
        ("net_offset", "m", "its part along the net's axis", LIST, ""),
        ("angle", "rad", "net's axis to the target's way back at each catch", LIST, ""),
    ],
)

FRAME = "world, z up; times from the start of planning"
COLUMNS = [*_CASE, START, *_CATCHES, *SOLVER, *OUTCOME, *_JUDGED, *MOTION, *TRAJECTORY]
