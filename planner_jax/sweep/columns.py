"""The columns of `plans.parquet`: a row a case, SI units, world frame (z up, net at x = 0)."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from planner_jax.optimise.status import Status
from planner_jax.referee.hit import HitVerdict
from planner_jax.task.hit import court
from planner_jax.task.hit.plan import HitPlan
from planner_jax.task.hit.scenario import HitScenario
from planner_jax.task.hit.serves import Serves


@dataclasses.dataclass(frozen=True)
class RefereedBatch:
    """N cases with everything that is known about them; leaves are NumPy or JAX arrays."""

    serves: Serves
    scenarios: HitScenario
    plans: HitPlan
    verdict: HitVerdict


class _Column(NamedTuple):
    name: str
    unit: str  # "" for names and counts, "1" for ratios
    meaning: str
    type: pa.DataType
    values: Callable[[RefereedBatch], Any]


_NUMBER, _VECTOR = pa.float32(), pa.list_(pa.float32(), 3)
_LIST = pa.list_(pa.float32())


def _case_columns() -> list[_Column]:
    """What was to be done."""
    vector = pa.list_(pa.float64(), 3)
    return [
        _Column("index", "", "place in the whole", pa.int64(), lambda b: b.serves.index),
        _Column(
            "scenario",
            "",
            "serve, landing and target region",
            pa.string(),
            lambda b: np.array(court.SCENARIOS)[b.serves.scenario],
        ),
        _Column("file", "", "trial file of the serve", pa.string(), lambda b: b.serves.file),
        _Column("line", "", "line of that file, from 1", pa.int32(), lambda b: b.serves.line),
        _Column("serve_pos", "m", "ball when served", vector, lambda b: b.serves.position),
        _Column("serve_vel", "m/s", "ball when served", vector, lambda b: b.serves.velocity),
        _Column("target", "m", "wanted landing point", vector, lambda b: b.serves.target),
        _Column(
            "ball_pos", "m", "ball when planning begins", _VECTOR, lambda b: b.scenarios.ball.pos
        ),
        _Column(
            "ball_vel", "m/s", "ball when planning begins", _VECTOR, lambda b: b.scenarios.ball.vel
        ),
        _Column(
            "start",
            "m",
            "hover position of the quadrotor",
            _VECTOR,
            lambda b: np.asarray(b.scenarios.head_state)[:, 0],
        ),
    ]


def _plan_columns() -> list[_Column]:
    """What the planner says; times from the moment at which planning begins."""
    rows = [
        ("contact_time", "s", "of the impact", _NUMBER, "stroke.time"),
        ("contact_pos", "m", "ball at the impact", _VECTOR, "stroke.ball_pos"),
        ("ball_vel_before", "m/s", "ball just before the impact", _VECTOR, "stroke.ball_vel"),
        ("ball_vel_after", "m/s", "ball just after the impact", _VECTOR, "stroke.ball_vel_after"),
        ("normal", "1", "unit normal of the racket at the impact", _VECTOR, "stroke.normal"),
        ("flight_time", "s", "from the impact to the landing", _NUMBER, "stroke.flight_time"),
        ("cost", "1", "the planner's own objective", _NUMBER, "cost"),
        ("violation", "1", "largest relative excess the planner saw", _NUMBER, "violation"),
        ("iterations", "", "of the round that gave the plan", pa.int32(), "iterations"),
    ]
    columns = [
        _Column(name, unit, meaning, kind, lambda b, path=path: _leaf(b.plans, path))
        for name, unit, meaning, kind, path in rows
    ]
    status = _Column("status", "", "of the solver", pa.string(), lambda b: _status(b.plans.status))
    return [*columns, status]


def _verdict_columns() -> list[_Column]:
    """What the referee found."""
    rows = [
        ("success", "", "the referee's word", pa.bool_()),
        ("failed_limit", "", "first limit that fails, or empty", pa.string()),
        ("failed_time", "s", "where that limit is worst", _NUMBER),
        ("failed_excess", "as in `sentence`", "by how much, tolerance not taken off", _NUMBER),
        ("max_speed", "m/s", "of the quadrotor", _NUMBER),
        ("max_acceleration", "m/s^2", "of the quadrotor", _NUMBER),
        ("max_body_rate", "rad/s", "of the quadrotor", _NUMBER),
        ("min_height", "m", "of the propeller plane", _NUMBER),
        ("min_thrust", "m/s^2", "per unit mass", _NUMBER),
        ("max_thrust", "m/s^2", "per unit mass", _NUMBER),
        ("hitting_velocity", "m/s", "quadrotor and racket at the impact", _VECTOR),
        ("apex", "m", "of the returned ball", _NUMBER),
        ("landing_point", "m", "of the returned ball", _VECTOR),
        ("landing_error", "m", "horizontal, to the target", _NUMBER),
        ("contact_error", "m", "racket centre to ball at the impact", _NUMBER),
        ("continuity_error", "m", "worst jump between pieces", _NUMBER),
        ("head_error", "m", "of the state at time 0", _NUMBER),
    ]
    columns = [
        _Column(name, unit, meaning, kind, lambda b, name=name: getattr(b.verdict, name))
        for name, unit, meaning, kind in rows
    ]
    sentence = _Column("sentence", "", "what failed, in words", pa.string(), _sentences)
    return [*columns, sentence]


def _trajectory_columns() -> list[_Column]:
    """The trajectory, and the published outcome of the same serve."""
    durations = _Column(
        "durations", "s", "of the M pieces", _LIST, lambda b: b.plans.trajectory.durations
    )
    coeffs = _Column(
        "coeffs",
        "m/s^k",
        "M pieces x powers k = 0..D x 3 axes, flat",
        _LIST,
        lambda b: _flat(b.plans.trajectory.coeffs),
    )
    published = [
        _Column(
            published_column(planner),
            "",
            "published outcome, null where there is none",
            pa.bool_(),
            lambda b, place=place: _published(b.serves, place),
        )
        for place, planner in enumerate(court.PLANNERS)
    ]
    return [durations, coeffs, *published]


def published_column(planner: str) -> str:
    """Name of the column with the published outcomes of a planner."""
    return f"published_{planner.replace('-', '_')}"


def rows_of(batch: RefereedBatch) -> pa.Table:
    """The rows of a batch."""
    columns = _case_columns() + _plan_columns() + _verdict_columns() + _trajectory_columns()
    num = len(batch.serves)
    fields = [
        pa.field(c.name, c.type, metadata={"unit": c.unit, "meaning": c.meaning}) for c in columns
    ]
    arrays = [_array(column.values(batch), column.type, num) for column in columns]
    metadata = {"frame": "world, z up, net at x = 0; times from the start of planning"}
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=metadata))


def _array(values: Any, kind: pa.DataType, num: int) -> pa.Array:
    """An Arrow array of `num` entries from (num,) or (num, length) values."""
    if values is None:
        return pa.nulls(num, kind)
    if isinstance(values, pa.Array):
        return values
    values = np.asarray(values)
    if not isinstance(kind, pa.FixedSizeListType | pa.ListType):
        return pa.array(values.tolist() if values.dtype.kind == "U" else values, kind)
    flat = pa.array(np.ravel(values), kind.value_type, safe=False)
    if isinstance(kind, pa.FixedSizeListType):
        return pa.FixedSizeListArray.from_arrays(flat, type=kind)
    offsets = np.arange(num + 1, dtype=np.int32) * (values.size // num)
    return pa.ListArray.from_arrays(pa.array(offsets), flat, type=kind)


def _leaf(tree: Any, path: str) -> np.ndarray:
    for name in path.split("."):
        tree = getattr(tree, name)
    return np.asarray(tree)


def _flat(coeffs: Any) -> np.ndarray:
    return np.asarray(coeffs).reshape(len(coeffs), -1)


def _status(status: Any) -> np.ndarray:
    return np.array([Status(code).name for code in np.asarray(status)])


def _sentences(batch: RefereedBatch) -> np.ndarray:
    verdict = batch.verdict
    return np.array(
        ["" if good else verdict.sentence(lane) for lane, good in enumerate(verdict.success)]
    )


def _published(serves: Serves, place: int) -> pa.Array | None:
    if serves.published is None:
        return None
    outcome = serves.published[:, place]
    return pa.array(outcome == 1.0, pa.bool_(), mask=np.isnan(outcome))
