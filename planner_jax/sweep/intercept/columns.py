"""The columns of an intercept run: car, target, obstacles, plan and verdict.

N obstacles of V corners each, so that lists of a row have N entries, or those of all corners one
behind the other; polygons with fewer corners repeat one.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
from jaxtyping import PyTree

from planner_jax.runs import columns as known
from planner_jax.runs.columns import LIST, VECTOR, Column, RefereedBatch, leaves_of, list_of

FRAME = "world, in the plane, headings counter-clockwise from x; times from the car's start"
WAY_POINTS = 65  # of a target's way
_FLAGS, _POINT = list_of(pa.bool_()), list_of(pa.float32(), 2)


def _target(name: str, unit: str, meaning: str, kind: pa.DataType) -> Column:
    """Return a leaf of targets that turn evenly; null for those of another class."""
    values = lambda b: vars(b.cases.target).get(name)  # noqa: E731
    return Column(f"target_{name}", unit, meaning, kind, values)


def _target_way(batch: RefereedBatch) -> np.ndarray:
    times = np.asarray(batch.cases.time)[:, None] * np.linspace(0.0, 1.0, WAY_POINTS)
    return np.asarray(_positions(batch.cases.target, jnp.asarray(times, jnp.float32)))


@jax.jit
def _positions(targets: PyTree, times: jax.Array) -> jax.Array:
    """Return where targets (B,) are at times (B, K) [s], (B, K, 2) [m]."""
    return jax.vmap(jax.vmap(lambda path, time: path.at(time).pos, (None, 0)))(targets, times)


def _corners(name: str) -> Callable[[RefereedBatch], np.ndarray]:
    """Return corners of walls or movers in the world at time 0, (B, N, V, 2)."""

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
        ("initial_curvature", "1/m", "of the car's way", known.NUMBER, "curvature"),
        ("due_time", "s", "when to meet the target, or until when", known.NUMBER, "time"),
        ("tolerance", "m", "from the body's middle to the target"),
        ("end_heading", "rad", "asked for at the meeting"),
        ("heading_tolerance", "rad", "pi leaves the heading free"),
    ),
    _target("pos", "m", "expected target at time 0, if it turns evenly", _POINT),
    _target("vel", "m/s", "of it at time 0", _POINT),
    _target("turn_rate", "rad/s", "of it, to the left", known.NUMBER),
    Column(
        "target_way",
        "m",
        f"expected target at {WAY_POINTS} even times from 0 to `due_time`, x and y",
        LIST,
        _target_way,
    ),
    Column("wall_corners", "m", "N x V x 2", LIST, _corners("walls")),
    Column("mover_corners", "m", "at time 0, N x V x 2", LIST, _corners("movers")),
    *leaves_of(
        "cases",
        ("wall_present", "", "which of the walls there are", _FLAGS, "walls.present"),
        ("mover_present", "", "which of the movers there are", _FLAGS, "movers.present"),
        ("mover_velocity", "m/s", "N x 2", LIST, "movers.velocity"),
    ),
    *leaves_of(
        "plans",
        ("meeting_time", "s", "when the plan ends", known.NUMBER, "time"),
        ("meeting", "m", "where the planner takes the target to be then", _POINT),
        ("speed", "m/s", "at equal knots from time 0 on", LIST),
        ("curvature", "1/m", "at the same knots", LIST),
    ),
    *known.SOLVER,
    *known.OUTCOME,
    *leaves_of(
        "verdict",
        ("miss", "m", "from the body's middle to the target at the end"),
        ("wall_clearance", "m", "of the body, least"),
        ("mover_clearance", "m", "of the body, least"),
        ("nearest_wall", "", "the wall that comes nearest, -1 without any", known.COUNT),
        ("nearest_mover", "", "likewise", known.COUNT),
        ("max_speed", "m/s", "of the car"),
        ("max_acceleration", "m/s^2", "along the way, either sign"),
        ("rms_acceleration", "m/s^2", "along the way"),
        ("max_lateral_acceleration", "m/s^2", "of the rear axle"),
        ("max_curvature", "1/m", "of the way"),
        ("max_steering_rate", "rad/s", "of the steering angle"),
    ),
]
