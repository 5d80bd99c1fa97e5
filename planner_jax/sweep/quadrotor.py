"""Columns that the runs of every quadrotor task have."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from planner_jax.runs.columns import LIST, VECTOR, Column, RefereedBatch, leaves_of


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


def _of_ending(name: str, unit: str, meaning: str) -> Column:
    """A leaf of the ways to rest; null where plans have none."""

    def values(batch: RefereedBatch) -> Any:
        return getattr(batch.plans.ending, name, None)

    return Column(f"ending_{name}", unit, meaning, LIST, values)


TRAJECTORY = [
    *leaves_of(
        "plans.trajectory",
        ("durations", "s", "of the pieces", LIST),
        ("coeffs", "m/s^k", "pieces x powers k = 0..D x 3 axes, flat", LIST),
    ),
    _of_ending("durations", "s", "of the pieces behind the last contact, to rest; null if none"),
    _of_ending("coeffs", "m/s^k", "likewise, as `coeffs`"),
]

_RESTS = {
    "brake": "to rest where that is cheapest",
    "home": "back to rest where the case begins",
}


def ending_remark(parameters: Mapping[str, Any]) -> list[str]:
    """What plans of a run do behind their last contact, if that was asked for, a sentence."""
    words = _RESTS.get(parameters.get("ending", ""))
    if words is None:
        return []
    return [f"Behind the last contact: {words}; a plan is a success with that or not at all."]
