"""Columns that the runs of every quadrotor task have."""

import numpy as np

from planner_jax.sweep.columns import LIST, VECTOR, Column, RefereedBatch, leaves_of


def _starts(batch: RefereedBatch) -> np.ndarray:
    return np.asarray(batch.cases.head_state)[:, 0]


START = Column("start", "m", "hover position of the quadrotor", VECTOR, _starts)

MOTION = leaves_of(
    "verdict",
    ("max_speed", "m/s", "of the quadrotor"),
    ("max_body_rate", "rad/s", "of the quadrotor"),
    ("min_height", "m", "of the propeller plane"),
    ("min_thrust", "m/s^2", "per unit mass"),
    ("max_thrust", "m/s^2", "per unit mass"),
    ("min_rotor_thrust", "N", "of any rotor; NaN where plans are not asked what the rotors do"),
    ("max_rotor_thrust", "N", "likewise"),
    ("continuity_error", "m", "worst jump between pieces"),
    ("head_error", "m", "of the state at time 0"),
)

TRAJECTORY = leaves_of(
    "plans.trajectory",
    ("durations", "s", "of the pieces", LIST),
    ("coeffs", "m/s^k", "pieces x powers k = 0..D x 3 axes, flat", LIST),
)
