"""The columns of a block run: ball, plan and verdict."""

import numpy as np

from planner_jax.runs import columns as known
from planner_jax.runs.columns import LIST, VECTOR, Column, RefereedBatch, leaves_of
from planner_jax.studies.block.flight_fit import Sight

FRAME = "base of the robot, z up; times from the moment at which the ball is first seen"

COLUMNS = [
    known.INDEX,
    *leaves_of(
        "cases",
        ("ball_pos", "m", "of the ball when it is first seen", VECTOR, "ball.pos"),
        ("ball_vel", "m/s", "its velocity then", VECTOR, "ball.vel"),
        ("delay", "s", "until the arm may start"),
        ("start_angles", "rad", "of the six joints until then", LIST, "angles"),
        ("start_rates", "rad/s", "of the joints then", LIST, "rates"),
        ("ends_at_rest", "", "whether the arm has to stand when it meets the ball", known.BOOL),
        ("offset", "m", "greatest distance of the ball from the shield's middle at the contact"),
        ("tilt_limit", "rad", "greatest angle off straight on", known.NUMBER, "tilt"),
    ),
    *leaves_of(
        "plans",
        ("planned_contact_time", "s", "of the plan", known.NUMBER, "contact_time"),
        ("motion_coeffs", "rad/s^k", "(pieces, powers, 6) of the joints", LIST, "motion.coeffs"),
        (
            "motion_durations",
            "s",
            "of the pieces, the first from the delay on",
            LIST,
            "motion.durations",
        ),
    ),
    *known.SOLVER,
    *leaves_of(
        "verdict",
        ("execution_time", "s", "how long the arm moves"),
        ("contact_time", "s", "when the shield meets the ball"),
        ("miss", "m", "of the ball from the shield's middle then"),
        ("tilt", "rad", "of the shield's normal against the ball's way then"),
        ("velocity_share", "1", "greatest rate over its limit"),
        ("acceleration_share", "1", "greatest acceleration over its limit"),
        ("pole_clearance", "m", "least"),
        ("floor_clearance", "m", "least"),
        ("rig_clearance", "m", "least"),
        ("base_clearance", "m", "least"),
        ("self_clearance", "m", "least, of the arm's parts and the shield from each other"),
        ("failed_part", "", "joint or links of the first limit that fails, or empty", known.TEXT),
    ),
    *known.OUTCOME,
]

# What runs with --perception have besides, and what those with --planning-budget have.
SEEN_COLUMNS = [
    Column(
        "sight", "", "what became of looking for the ball", known.TEXT, lambda batch: _sights(batch)
    ),
    *leaves_of(
        "plans",
        ("sightings", "", "frames with the ball until the first fit", known.COUNT),
        ("fit_error", "m", "of the first fit, across the flight midway between the boxes"),
        ("fit_std", "m", "what it is believed to be"),
        ("last_fit_error", "m", "of the last fit"),
        ("motions", "", "that were begun", known.COUNT),
    ),
]
TIMED_COLUMNS = leaves_of("plans", ("planning_time", "s", "of this plan alone"))


def _sights(batch: RefereedBatch) -> np.ndarray:
    names = np.array([Sight(code).name for code in range(len(Sight))])
    return names[np.asarray(batch.plans.sight)]
