"""Columns of stored cases of a car that meets a target: case, plan and referee's verdict."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
from jaxtyping import PyTree

from planner_jax.runs import columns as known
from planner_jax.runs.columns import LIST, VECTOR, Column, RefereedBatch, leaves_of, list_of

FRAME = "world, in the plane, headings counter-clockwise from x; times from the car's start"
WAY_POINTS = 65  # number of points at which the column `target_way` stores a target's path
_WAY = f"predicted target at {WAY_POINTS} evenly spaced times from 0 to `due_time`, x and y"
_FLAGS, _POINT = list_of(pa.bool_()), list_of(pa.float32(), 2)


def _target_way(batch: RefereedBatch) -> np.ndarray:
    times = np.asarray(batch.cases.time)[:, None] * np.linspace(0.0, 1.0, WAY_POINTS)
    return np.asarray(_positions(batch.cases.target, jnp.asarray(times, jnp.float32)))


@jax.jit
def _positions(targets: PyTree, times: jax.Array) -> jax.Array:
    return jax.vmap(jax.vmap(lambda path, time: path.at(time).pos, (None, 0)))(targets, times)


def _corners(name: str) -> Callable[[RefereedBatch], np.ndarray]:
    def values(batch: RefereedBatch) -> np.ndarray:
        group = vars(batch.cases)[name]
        return np.asarray(group.centre)[:, :, None] + np.asarray(group.corners)

    return values


COLUMNS = [
    known.INDEX,
    *leaves_of(
        "cases",
        ("start", "m, rad", "x, y of the rear axle and heading", VECTOR),
        ("initial_speed", "m/s", "of the car", known.NUMBER, "speed"),
        ("initial_curvature", "1/m", "of the car's path", known.NUMBER, "curvature"),
        ("due_time", "s", "prescribed or latest time of the meeting", known.NUMBER, "time"),
        ("tolerance", "m", "from the middle of the body to the target"),
        ("end_heading", "rad", "prescribed at the meeting"),
        ("heading_tolerance", "rad", "tolerance of this heading; pi leaves it free"),
        ("earliest", "s", "earliest time of the meeting"),
        ("end_speed_range", "m/s", "least and greatest speed at the meeting", _POINT, "end_speed"),
        ("margin", "m", "least distance from obstacles"),
        ("region", "m", "corners of the region around the target, V x 2", LIST),
        ("map_heading", "rad", "direction of the map's first axis"),
        ("origin", "m", "world position to which all positions are relative", _POINT),
    ),
    *leaves_of(
        "cases.target",
        ("target_pos", "m", "target with constant turn rate at time 0", _POINT, "pos"),
        ("target_vel", "m/s", "of this target at time 0", _POINT, "vel"),
        ("target_turn_rate", "rad/s", "of this target, to the left", known.NUMBER, "turn_rate"),
        optional=True,
    ),
    Column("target_way", "m", _WAY, LIST, _target_way),
    Column("wall_corners", "m", "N x V x 2", LIST, _corners("walls")),
    Column("mover_corners", "m", "at time 0, N x V x 2", LIST, _corners("movers")),
    *leaves_of(
        "cases",
        ("wall_present", "", "whether each wall exists", _FLAGS, "walls.present"),
        ("mover_present", "", "whether each mover exists", _FLAGS, "movers.present"),
        ("mover_velocity", "m/s", "N x 2", LIST, "movers.velocity"),
        ("wall_radius", "m", "by which each wall is enlarged", LIST, "walls.radius"),
        ("mover_radius", "m", "by which each mover is enlarged at time 0", LIST, "movers.radius"),
        ("wall_growth", "m/s", "growth of this radius", LIST, "walls.growth"),
        ("mover_growth", "m/s", "growth of this radius", LIST, "movers.growth"),
    ),
    *leaves_of(
        "plans",
        ("meeting_time", "s", "end of the plan", known.NUMBER, "time"),
        ("meeting", "m", "position of the target at the end, as predicted", _POINT),
        ("speed", "m/s", "at evenly spaced knots from time 0", LIST),
        ("curvature", "1/m", "at the same knots", LIST),
    ),
    *known.SOLVER,
    *known.OUTCOME,
    *leaves_of(
        "verdict",
        ("miss", "m", "from the body's middle to the target or its region at the end"),
        ("end_speed", "m/s", "of the car at the end"),
        ("wall_clearance", "m", "least clearance of the body"),
        ("mover_clearance", "m", "least clearance of the body"),
        ("nearest_wall", "", "index of the nearest wall; -1 without walls", known.COUNT),
        ("nearest_mover", "", "index of the nearest mover; -1 without movers", known.COUNT),
        ("max_speed", "m/s", "of the car"),
        ("max_acceleration", "m/s^2", "along the path, absolute value"),
        ("rms_acceleration", "m/s^2", "along the path"),
        ("max_jerk", "m/s^3", "along the path, absolute value"),
        ("max_lateral_acceleration", "m/s^2", "of the rear axle"),
        ("rms_lateral_acceleration", "m/s^2", "of the rear axle"),
        ("rms_lateral_jerk", "m/s^3", "of the rear axle"),
        ("max_curvature", "1/m", "of the path"),
        ("max_steering_rate", "rad/s", "of the steering angle"),
        ("rms_steering_rate", "rad/s", "of the steering angle"),
        ("total_curvature_variation", "1/m", "sum of the magnitudes of the curvature's changes"),
    ),
]
