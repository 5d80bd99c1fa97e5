"""Cases and plans of a finished run, restored from its table of cases for the command line."""

import numpy as np
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.arithmetic import host_leaf
from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import Plan, Status, take
from planner_jax.robot.arm import ArmPlan
from planner_jax.robot.car import CarPlan
from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.runs.manifest import Entries, Row
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.settings import settings_of_manifest
from planner_jax.sweep.quadrotor import air_of
from planner_jax.sweep.report import read_finished
from planner_jax.sweep.sweep import settings_of
from planner_jax.trajectory.polynomial import PiecewisePolynomial


def case_of_row(folder: RunFolder, row: int) -> PyTree:
    """Return the case of a row; raise an error if physics or limits differ from the manifest's."""
    manifest, sweep = read_finished(folder)
    settings = settings_of_manifest(settings_of(sweep.task), manifest["parameters"], folder.name)
    cases = sweep.open_source(settings.of(sweep.task), 1).cases(row, row + 1).cases
    is_same = sweep.setting(cases) == manifest["setting"]
    rule = "a run whose cases are drawn or read as before"
    folder.require(is_same, rule, f"others for row {row}")
    return take(cases, 0)


def read_plan(folder: RunFolder, row: int | None) -> tuple[Plan, str]:
    """Restore the plan from row `row` of a run; return also why the referee rejects it, or ""."""
    manifest, sweep = read_finished(folder)
    last = manifest["summary"]["num"] - 1
    if row is None or not 0 <= row <= last:
        shown = "nothing" if row is None else row
        raise ArgumentError("row", f"from 0 to {last}", shown=str(shown))
    if sweep.plan_of_row is None:
        rule = "a file of plan.save, as rows of this task are not read back as plans"
        raise ArgumentError(folder.name, rule, shown=f"a {sweep.kind}")
    with folder.reading_rows():
        (found,) = folder.plans.pick([row])
        return sweep.plan_of_row(found, manifest["setting"]), found["sentence"]


def quadrotor_plan(row: Row, setting: Entries) -> QuadrotorPlan:
    """Restore a quadrotor's plan from a run's row; the manifest's `setting` has gravity and air."""
    rest = row.get("recovery_durations")
    return QuadrotorPlan(
        **_outcome(row),
        trajectory=_polynomial(row["coeffs"], row["durations"], 3),
        gravity=_numbers(setting["gravity"]),
        recovery=None if rest is None else _polynomial(row["recovery_coeffs"], rest, 3),
        air=air_of(setting),
    )


def arm_plan(row: Row, setting: Entries) -> ArmPlan:
    """Restore an arm's plan from a run's row; the motion starts at the `delay` [s] of its case."""
    joints = int(setting.get("joints", 6))
    motion = _polynomial(row["motion_coeffs"], row["motion_durations"], joints)
    return ArmPlan(**_outcome(row), motion=motion)


def car_plan(row: Row, _: Entries) -> CarPlan:
    """Restore a car's plan from a run's row: speed and curvature at equally spaced times."""
    knots = {name: _numbers(row[name]) for name in ("start", "speed", "curvature")}
    # Runs of version 0.2 have no column `origin`.
    time, origin = _numbers(row["meeting_time"]), _numbers(row.get("origin", [0.0, 0.0]))
    return CarPlan(**_outcome(row), time=time, origin=origin, **knots)


def _outcome(row: Row) -> Entries:
    counts = {"iterations": row["iterations"], "status": Status[row["status"]]}
    return {
        **{name: _numbers(row[name]) for name in ("cost", "violation")},
        **{name: host_leaf(count, np.int32) for name, count in counts.items()},
    }


def _polynomial(coeffs: list, durations: list, axes: int) -> PiecewisePolynomial:
    pieces = _numbers(coeffs).reshape(len(durations), -1, axes)
    return PiecewisePolynomial(coeffs=pieces, durations=_numbers(durations))


def _numbers(values: float | list) -> Array:
    return host_leaf(values, np.float32)
