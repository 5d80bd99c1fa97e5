"""The columns of `plans.parquet`: a row a case, SI units, world frame (z up)."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from planner_jax.protocol import Status
from planner_jax.sweep.source import Cases


@dataclasses.dataclass(frozen=True)
class RefereedBatch:
    """B cases with everything that is known about them; leaves are NumPy or JAX arrays."""

    cases: Cases
    scenarios: Any  # as they were planned, with what was decided about them
    plans: Any
    verdict: Any


class Column(NamedTuple):
    """One column of a task's rows."""

    name: str
    unit: str  # "" for names and counts, "1" for ratios
    meaning: str
    type: pa.DataType
    values: Callable[[RefereedBatch], Any]  # (B,) or (B, ...), lists flat; None: all null


BOOL, TEXT, COUNT, NUMBER = pa.bool_(), pa.string(), pa.int32(), pa.float32()


def list_of(kind: pa.DataType, length: int = -1) -> pa.DataType:
    """The type of a list column, under the name that Parquet gives its entries back."""
    return pa.list_(pa.field("element", kind), length)


VECTOR, LIST = list_of(pa.float32(), 3), list_of(pa.float32())

INDEX = Column("index", "", "place in the whole", pa.int64(), lambda b: b.cases.index)
START = Column(
    "start",
    "m",
    "hover position of the quadrotor",
    VECTOR,
    lambda b: np.asarray(b.scenarios.head_state)[:, 0],
)


def leaves_of(part: str, rows: Sequence[tuple[str, str, str, pa.DataType, str]]) -> list[Column]:
    """Columns that are leaves of one part of a batch.

    Args:
        part: field of `RefereedBatch`.
        rows: name, unit, meaning and type of a column, and the dotted path of the leaf; the
            path "" is the name itself.
    """
    return [
        Column(name, unit, meaning, kind, lambda b, at=path or name: _leaf(getattr(b, part), at))
        for name, unit, meaning, kind, path in rows
    ]


SOLVER = [
    *leaves_of(
        "plans",
        [
            ("cost", "1", "the planner's own objective", NUMBER, ""),
            ("violation", "1", "largest relative excess the planner saw", NUMBER, ""),
            ("iterations", "", "of the round that gave the plan", COUNT, ""),
        ],
    ),
    Column("status", "", "of the solver", TEXT, lambda b: _status(b.plans.status)),
]

OUTCOME = leaves_of(
    "verdict",
    [
        ("success", "", "the referee's word", BOOL, ""),
        ("failed_limit", "", "first limit that fails, or empty", TEXT, ""),
        ("failed_time", "s", "where that limit is worst", NUMBER, ""),
        ("failed_excess", "as in `sentence`", "by how much, tolerance not taken off", NUMBER, ""),
        ("max_speed", "m/s", "of the quadrotor", NUMBER, ""),
        ("max_body_rate", "rad/s", "of the quadrotor", NUMBER, ""),
        ("min_height", "m", "of the propeller plane", NUMBER, ""),
        ("min_thrust", "m/s^2", "per unit mass", NUMBER, ""),
        ("max_thrust", "m/s^2", "per unit mass", NUMBER, ""),
    ],
)

ERRORS = [
    *leaves_of(
        "verdict",
        [
            ("continuity_error", "m", "worst jump between pieces", NUMBER, ""),
            ("head_error", "m", "of the state at time 0", NUMBER, ""),
        ],
    ),
    Column("sentence", "", "what failed, in words", TEXT, lambda b: _sentences(b.verdict)),
]

TRAJECTORY = leaves_of(
    "plans",
    [
        ("durations", "s", "of the pieces", LIST, "trajectory.durations"),
        (
            "coeffs",
            "m/s^k",
            "pieces x powers k = 0..D x 3 axes, flat",
            LIST,
            "trajectory.coeffs",
        ),
    ],
)


def rows_of(columns: Sequence[Column], batch: RefereedBatch, frame: str) -> pa.Table:
    """The rows of a batch.

    Args:
        columns: of the task.
        batch: the cases.
        frame: axes and times of the columns, in words, for the metadata.
    """
    num = len(batch.cases)
    fields = [
        pa.field(c.name, c.type, metadata={"unit": c.unit, "meaning": c.meaning}) for c in columns
    ]
    arrays = [_array(column.values(batch), column.type, num) for column in columns]
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata={"frame": frame}))


def _array(values: Any, kind: pa.DataType, num: int) -> pa.Array:
    """An Arrow array of `num` entries from (num,) or (num, ...) values."""
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


def _leaf(tree: Any, path: str) -> Any:
    for name in path.split("."):
        tree = getattr(tree, name)
    return tree


_STATUS_NAMES = np.array([Status(code).name for code in range(len(Status))])


def _status(status: Any) -> np.ndarray:
    return _STATUS_NAMES[np.asarray(status)]


def _sentences(verdict: Any) -> np.ndarray:
    return np.array(
        ["" if good else verdict.sentence(lane) for lane, good in enumerate(verdict.success)]
    )
