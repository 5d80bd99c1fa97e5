"""Columns of stored cases of hitting a ball: serve, plan and the referee's verdict."""

import numpy as np
import pyarrow as pa

from planner_jax.baselines.hit.comparison import OUTCOMES
from planner_jax.runs import columns as known
from planner_jax.runs.columns import COUNT, TEXT, VECTOR, Column, leaves_of, list_of
from planner_jax.sweep.quadrotor import MOTION, START, TRAJECTORY
from planner_jax.task.hit import court

FRAME = "world, z up, net at x = 0; times from the start of planning"
_POINT = list_of(pa.float64(), 3)
_names = lambda b: np.array(court.SCENARIOS)[b.chunk.origin.scenario]  # noqa: E731

COLUMNS = [
    known.INDEX,
    Column("scenario", "", "serve, landing and target region", TEXT, _names),
    *leaves_of(
        "chunk",
        ("file", "", "trial file of the serve", TEXT, "origin.file"),
        ("line", "", "line of that file, from 1", COUNT, "origin.line"),
        ("serve_pos", "m", "ball when served", _POINT, "origin.position"),
        ("serve_vel", "m/s", "ball when served", _POINT, "origin.velocity"),
        ("target", "m", "desired landing point", _POINT, "origin.target"),
        ("ball_pos", "m", "ball when planning starts", VECTOR, "cases.ball.pos"),
        ("ball_vel", "m/s", "ball when planning starts", VECTOR, "cases.ball.vel"),
    ),
    START,
    *leaves_of(
        "plans.stroke",
        ("contact_time", "s", "of the impact", known.NUMBER, "time"),
        ("contact_pos", "m", "ball at the impact", VECTOR, "ball_pos"),
        ("ball_vel_before", "m/s", "ball just before the impact", VECTOR, "ball_vel"),
        ("ball_vel_after", "m/s", "ball just after the impact", VECTOR),
        ("normal", "1", "unit normal of the racket at the impact", VECTOR),
        ("flight_time", "s", "from the impact to the landing"),
    ),
    *known.SOLVER,
    *known.OUTCOME,
    *leaves_of(
        "verdict",
        ("max_acceleration", "m/s^2", "of the quadrotor"),
        ("hitting_velocity", "m/s", "quadrotor and racket at the impact", VECTOR),
        ("apex", "m", "of the returned ball"),
        ("landing_point", "m", "of the returned ball", VECTOR),
        ("landing_error", "m", "horizontal, to the target"),
        ("contact_error", "m", "racket centre to ball at the impact"),
    ),
    *MOTION,
    *TRAJECTORY,
    *OUTCOMES,
]

_ORIGIN = ("scenario", "file", "line", "serve_pos", "serve_vel", "target")
# Columns for a single case of the user, which has no court scenario, serve or published result.
SINGLE_COLUMNS = [
    *(c for c in COLUMNS if c.name not in _ORIGIN and c not in OUTCOMES),
    *leaves_of("cases", ("target", "m", "desired landing point", VECTOR)),
]
