"""The columns of a hit run: what was served, planned and judged."""

import numpy as np
import pyarrow as pa

from planner_jax.sweep.columns import (
    BOOL,
    COUNT,
    INDEX,
    NUMBER,
    OUTCOME,
    SOLVER,
    TEXT,
    VECTOR,
    Column,
    leaves_of,
    list_of,
)
from planner_jax.sweep.quadrotor import MOTION, START, TRAJECTORY
from planner_jax.task.hit import court
from planner_jax.task.hit.serves import Serves

_POINT = list_of(pa.float64(), 3)

_CASE = [
    INDEX,
    Column(
        "scenario",
        "",
        "serve, landing and target region",
        TEXT,
        lambda b: np.array(court.SCENARIOS)[b.chunk.origin.scenario],
    ),
    *leaves_of(
        "chunk",
        [
            ("file", "", "trial file of the serve", TEXT, "origin.file"),
            ("line", "", "line of that file, from 1", COUNT, "origin.line"),
            ("serve_pos", "m", "ball when served", _POINT, "origin.position"),
            ("serve_vel", "m/s", "ball when served", _POINT, "origin.velocity"),
            ("target", "m", "wanted landing point", _POINT, "origin.target"),
            ("ball_pos", "m", "ball when planning begins", VECTOR, "cases.ball.pos"),
            ("ball_vel", "m/s", "ball when planning begins", VECTOR, "cases.ball.vel"),
        ],
    ),
]

# Times count from the moment at which planning begins.
_STROKE = leaves_of(
    "plans",
    [
        ("contact_time", "s", "of the impact", NUMBER, "stroke.time"),
        ("contact_pos", "m", "ball at the impact", VECTOR, "stroke.ball_pos"),
        ("ball_vel_before", "m/s", "ball just before the impact", VECTOR, "stroke.ball_vel"),
        ("ball_vel_after", "m/s", "ball just after the impact", VECTOR, "stroke.ball_vel_after"),
        ("normal", "1", "unit normal of the racket at the impact", VECTOR, "stroke.normal"),
        ("flight_time", "s", "from the impact to the landing", NUMBER, "stroke.flight_time"),
    ],
)

_JUDGED = leaves_of(
    "verdict",
    [
        ("max_acceleration", "m/s^2", "of the quadrotor", NUMBER, ""),
        ("hitting_velocity", "m/s", "quadrotor and racket at the impact", VECTOR, ""),
        ("apex", "m", "of the returned ball", NUMBER, ""),
        ("landing_point", "m", "of the returned ball", VECTOR, ""),
        ("landing_error", "m", "horizontal, to the target", NUMBER, ""),
        ("contact_error", "m", "racket centre to ball at the impact", NUMBER, ""),
    ],
)


def published_column(planner: str) -> str:
    """Name of the column with the published outcomes of a planner."""
    return f"published_{planner.replace('-', '_')}"


def _published(serves: Serves, place: int) -> pa.Array | None:
    if serves.published is None:
        return None
    outcome = serves.published[:, place]
    return pa.array(outcome == 1.0, pa.bool_(), mask=np.isnan(outcome))


_PUBLISHED = [
    Column(
        published_column(planner),
        "",
        "published outcome, null where there is none",
        BOOL,
        lambda b, place=place: _published(b.chunk.origin, place),
    )
    for place, planner in enumerate(court.PLANNERS)
]

FRAME = "world, z up, net at x = 0; times from the start of planning"
COLUMNS = [*_CASE, START, *_STROKE, *SOLVER, *OUTCOME, *_JUDGED, *MOTION, *TRAJECTORY, *_PUBLISHED]
