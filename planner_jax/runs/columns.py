"""Columns of a run's stored table, which has a row for each case, its plan and its verdict."""

import dataclasses
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa
from jaxtyping import ArrayLike, PyTree

from planner_jax.core.protocol import Status
from planner_jax.runs.source import Chunk


@dataclasses.dataclass(frozen=True)
class RefereedBatch:
    """B cases, their plans and the referee's verdicts, whose leaves are arrays (B, ...)."""

    chunk: Chunk
    plans: PyTree
    verdict: PyTree

    @property
    def cases(self) -> PyTree:
        """The B cases, with leaves (B, ...)."""
        return self.chunk.cases


Values: TypeAlias = ArrayLike | pa.Array | None


class Column(NamedTuple):
    """A column of the stored table of planned problems, and the function that fills the column."""

    name: str
    unit: str  # SI unit; "" for names and counts, "1" for ratios
    meaning: str  # text for the metadata of the Parquet file
    type: pa.DataType
    # Function that returns a value or list for each of B rows, or None if all values are missing.
    values: Callable[[RefereedBatch], Values]


BOOL, TEXT, COUNT, NUMBER = pa.bool_(), pa.string(), pa.int32(), pa.float32()
_KINDS = {"b": BOOL, "U": TEXT, "i": COUNT}  # Arrow types of columns by the `kind` of NumPy dtypes


def list_of(kind: pa.DataType, length: int = -1) -> pa.DataType:
    """Return the Arrow type of a column of lists of `kind`; -1 as `length` allows any length."""
    return pa.list_(pa.field("element", kind), length)


VECTOR, LIST = list_of(pa.float32(), 3), list_of(pa.float32())

INDEX = Column("index", "", "index of the case in the run", pa.int64(), lambda b: b.chunk.index)


def leaves_of(part: str, *rows: tuple, optional: bool = False) -> list[Column]:
    """Return columns whose values are leaves of a subtree of a `RefereedBatch`.

    Args:
        part: dotted path of the subtree, such as "plans" or "cases.targets".
        *rows: one tuple a column: name, unit and meaning, then optionally the type, by default
            NUMBER, and the dotted path of the leaf within the subtree, by default the name.
        optional: whether a missing leaf gives missing values; if false, it raises an error.
    """

    def column(
        name: str, unit: str, meaning: str, kind: pa.DataType = NUMBER, path: str = ""
    ) -> Column:
        place = f"{part}.{path or name}"
        return Column(name, unit, meaning, kind, lambda b: _leaf(b, place, optional))

    return [column(*row) for row in rows]


_STATUS_NAMES = np.array([Status(code).name for code in range(len(Status))])


def status_column(meaning: str) -> Column:
    """Return the column `status`: the name of each plan's status, such as "CONVERGED"."""
    return Column("status", "", meaning, TEXT, lambda b: _STATUS_NAMES[np.asarray(b.plans.status)])


SOLVER = [
    *leaves_of(
        "plans",
        ("cost", "1", "the planner's own objective"),
        ("violation", "1", "largest relative excess that the planner measured"),
        ("iterations", "", "of the attempt that found the plan", COUNT),
    ),
    status_column("of the solver"),
]

OUTCOME = [
    *leaves_of(
        "verdict",
        ("success", "", "whether the referee accepts the plan", BOOL),
        ("failed_limit", "", "first limit that fails, or empty", TEXT),
        ("failed_time", "s", "at which this limit is exceeded most"),
        ("failed_excess", "as in `sentence`", "excess over this limit, tolerance not subtracted"),
    ),
    Column("sentence", "", "failure as a sentence", TEXT, lambda b: _sentences(b.verdict)),
]


def leaf_columns(batch: RefereedBatch) -> list[Column]:
    """Return a column for every leaf of the cases, the plans and the verdict.

    A column's name is the path of its leaf, such as "plan.motion.durations". Columns that the runs
    of all tasks have, such as "cost", have short names. Dataclass fields state unit and meaning.
    """
    known = {f"plan.{c.name}" for c in SOLVER} | {f"verdict.{c.name}" for c in OUTCOME}
    found = [INDEX]
    for name, part in (("case", "cases"), ("plan", "plans"), ("verdict", "verdict")):
        read = operator.attrgetter(part)
        found += [c for c in _columns_of(read(batch), name, read, {}) if c.name not in known]
    return [*found, *SOLVER, *OUTCOME]


def _columns_of(
    tree: PyTree,
    name: str,
    read: Callable[[RefereedBatch], PyTree],
    words: Mapping[str, str],
) -> Iterator[Column]:
    """Yield a column for every array (B, ...) of `tree`, which `read` returns from a batch."""
    if dataclasses.is_dataclass(tree):
        for f in dataclasses.fields(tree):
            if f.metadata.get("pytree_node", True):  # a static field has one value for all rows
                inner = lambda batch, f=f: vars(read(batch))[f.name]  # noqa: E731
                yield from _columns_of(vars(tree)[f.name], f"{name}.{f.name}", inner, f.metadata)
    elif isinstance(tree, tuple | list | dict):
        for key in tree if isinstance(tree, dict) else range(len(tree)):
            inner = lambda batch, key=key: read(batch)[key]  # noqa: E731
            yield from _columns_of(tree[key], f"{name}.{key}", inner, words)
    elif tree is not None:  # an optional part that no case has fills no column
        values, unit, meaning = np.asarray(tree), words.get("unit", ""), words.get("meaning", "")
        kind = _KINDS.get(values.dtype.kind, NUMBER)
        yield Column(name, unit, meaning, kind if values.ndim == 1 else list_of(kind), read)


def rows_of(columns: Sequence[Column], batch: RefereedBatch, frame: str) -> pa.Table:
    """Return a table with one row for each case; its metadata describe the coordinate `frame`."""
    words = [{"unit": column.unit, "meaning": column.meaning} for column in columns]
    fields = [pa.field(c.name, c.type, metadata=w) for c, w in zip(columns, words, strict=True)]
    arrays = [_array(column.values(batch), column.type, len(batch.chunk)) for column in columns]
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata={"frame": frame}))


def _array(values: Values, kind: pa.DataType, num: int) -> pa.Array:
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


def _leaf(tree: PyTree, path: str, optional: bool = False) -> Values:
    default = (None,) if optional else ()
    for name in path.split("."):
        tree = getattr(tree, name, *default)
    return tree


def _sentences(verdict: PyTree) -> np.ndarray:
    pairs = enumerate(verdict.success)
    return np.array(["" if success else verdict.sentence(index) for index, success in pairs])
