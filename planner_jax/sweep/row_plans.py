"""Plans as `plans.parquet` holds them: a row's numbers, bit for bit, in its robot's class."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from planner_jax.core.protocol import Status
from planner_jax.robot.arm_plan import ArmPlan
from planner_jax.robot.car import CarPlan
from planner_jax.robot.quadrotor_plan import QuadrotorPlan
from planner_jax.trajectory.polynomial import PiecewisePolynomial

Row = Mapping[str, Any]


def quadrotor_plan(row: Row, setting: Row) -> QuadrotorPlan:
    """The plan of a row with the columns `TRAJECTORY`; gravity is that of the run's setting."""
    rest = row.get("ending_durations")
    return QuadrotorPlan(
        **_outcome(row),
        trajectory=_polynomial(row["coeffs"], row["durations"], 3),
        gravity=_numbers(setting["gravity"]),
        ending=None if rest is None else _polynomial(row["ending_coeffs"], rest, 3),
    )


def arm_plan(row: Row) -> ArmPlan:
    """The plan of a row of blocks; it begins when the arm may start, at the row's `delay`."""
    return ArmPlan(
        **_outcome(row), motion=_polynomial(row["motion_coeffs"], row["motion_durations"], 6)
    )


def car_plan(row: Row) -> CarPlan:
    """The plan of a row of interceptions."""
    names = ("start", "speed", "curvature")
    knots = {name: _numbers(row[name]) for name in names}
    return CarPlan(**_outcome(row), time=_numbers(row["meeting_time"]), **knots)


def _outcome(row: Row) -> dict[str, Any]:
    """The fields that every plan has."""
    counts = {"iterations": row["iterations"], "status": Status[row["status"]]}
    return {
        **{name: _numbers(row[name]) for name in ("cost", "violation")},
        **{name: np.asarray(count, np.int32) for name, count in counts.items()},
    }


def _polynomial(coeffs: Any, durations: Any, axes: int) -> PiecewisePolynomial:
    pieces = _numbers(coeffs).reshape(len(durations), -1, axes)
    return PiecewisePolynomial(coeffs=pieces, durations=_numbers(durations))


def _numbers(values: Any) -> Any:
    return np.asarray(values, np.float32)
