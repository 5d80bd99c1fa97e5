"""Columns that the runs of every quadrotor task have."""

import numpy as np

from planner_jax.sweep.columns import LIST, NUMBER, VECTOR, Column, leaves_of

START = Column(
    "start",
    "m",
    "hover position of the quadrotor",
    VECTOR,
    lambda b: np.asarray(b.cases.head_state)[:, 0],
)


MOTION = leaves_of(
    "verdict",
    [
        ("max_speed", "m/s", "of the quadrotor", NUMBER, ""),
        ("max_body_rate", "rad/s", "of the quadrotor", NUMBER, ""),
        ("min_height", "m", "of the propeller plane", NUMBER, ""),
        ("min_thrust", "m/s^2", "per unit mass", NUMBER, ""),
        ("max_thrust", "m/s^2", "per unit mass", NUMBER, ""),
        ("continuity_error", "m", "worst jump between pieces", NUMBER, ""),
        ("head_error", "m", "of the state at time 0", NUMBER, ""),
    ],
)

TRAJECTORY = leaves_of(
    "plans",
    [
        ("durations", "s", "of the pieces", LIST, "trajectory.durations"),
        (
            "coeffs",
            "m/s^k",
            "pieces x powers k = 0..D x 3 axes, flat",
            LIST,
            "trajectory.coeffs",
        ),
    ],
)
