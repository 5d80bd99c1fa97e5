"""The parts of a sweep: the rows of one chunk each, in `parts/` until all are joined.

A part is checked, not trusted. Its name holds the checksum of the file; its metadata say of which
run it is, made by what, of which settings, and which rows it holds. What does not agree is removed
with a word on the standard error stream, and its cases are planned again.
"""

import dataclasses
import io
import json
import sys
import zlib
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from planner_jax.plain_files import open_plain
from planner_jax.sweep.manifest import FORMAT, is_count, is_number
from planner_jax.sweep.parquet import ROW_GROUP, encoding, opened
from planner_jax.sweep.plain_json import JsonError, parse_object
from planner_jax.sweep.run_folder import RunFolder
from planner_jax.sweep.settings import SettingError
from planner_jax.sweep.source import Source
from planner_jax.whole_files import replacing

_RECORD = b"part"
_DIGITS = 12  # of a part's number, at most
_SECONDS = ("plan_seconds", "compile_seconds", "referee_seconds", "wall_seconds")


class PartError(ValueError):
    """A file is not a part of the run; a few words that say why."""


class _Pieces(io.RawIOBase):
    """A file in memory, as the pieces that were written: one block would be moved as it grows."""

    def __init__(self) -> None:
        self.pieces: list[Any] = []
        self.sum = 0

    def writable(self) -> bool:
        return True

    def write(self, piece: Any) -> int:
        self.pieces.append(piece)
        self.sum = zlib.crc32(piece, self.sum)
        return len(piece)


@dataclasses.dataclass(frozen=True)
class Part:
    """A part that is sound."""

    path: Path
    record: dict[str, Any]  # how its rows came about

    def read(self) -> pa.Table:
        """Its rows."""
        with opened(self.path) as file:
            rows = file.read()
        kept = {key: value for key, value in rows.schema.metadata.items() if key != _RECORD}
        return rows.replace_schema_metadata(kept)


@dataclasses.dataclass(frozen=True)
class Parts:
    """The parts of one run.

    Args:
        run: folder of the run, in whose `parts` they lie.
        identity: of the run, as its manifest has it: `run`, `settings` and `code`.
        source: of the cases.
    """

    run: RunFolder
    identity: dict[str, str]
    source: Source

    @property
    def folder(self) -> Path:
        """Where they lie; it need not exist."""
        return self.run.parts

    def write(self, number: int, rows: pa.Table, record: dict[str, Any]) -> dict[str, Any]:
        """Write the rows of a chunk; gives the record of how they came about as it is kept."""
        self.folder.mkdir(exist_ok=True)
        record = {**self._own(number), **record}
        metadata = {**(rows.schema.metadata or {}), _RECORD: json.dumps(record).encode()}
        rows = rows.replace_schema_metadata(metadata)
        written = _Pieces()
        pq.write_table(rows, written, row_group_size=ROW_GROUP, **encoding(rows.schema))
        name = f"part-{number:06d}-{written.sum:08x}.parquet"
        with replacing(self.folder / name) as scratch, open(scratch, "wb") as file:
            file.writelines(written.pieces)
        self.run.sent(self.folder / name)
        return record

    def sound(self) -> dict[int, Part]:
        """The parts that are there, by their numbers; removes what is none.

        The folder is looked through once, whatever parts there could be.
        """
        found: dict[int, Part] = {}
        for path in sorted(self.folder.iterdir()) if self.folder.is_dir() else ():
            try:
                number, record = self._record(path)
                if number in found:
                    raise PartError("is there twice")
                found[number] = Part(path, record)
            except (PartError, JsonError) as error:
                print(
                    f"planner-jax: {path} {error}; what it held is planned again", file=sys.stderr
                )
                self.run.dropped(path)
        return found

    def require_plain(self, name: str) -> None:
        """Raise `SettingError` if a pipe, a device or a folder stands in the place of a part.

        Args:
            name: of the caller's argument that holds the run's folder, for the message.
        """
        for path in sorted(self.folder.iterdir()) if self.folder.is_dir() else ():
            if not path.is_file():
                rule = "a run whose parts are plain files"
                raise SettingError(f"{name} must be {rule}, got {str(path)!r}, which is none")

    def _own(self, number: int) -> dict[str, Any]:
        """What a part must say of itself."""
        first = number * self.source.batch
        num = min(self.source.batch, self.source.num - first)
        return {"format": FORMAT, **self.identity, "first": first, "num": num}

    def _record(self, path: Path) -> tuple[int, dict[str, Any]]:
        """Number and record of a part.

        Raises:
            PartError, JsonError: the file is none of this run, or damaged.
        """
        word, _, rest = path.stem.partition("-")
        number, _, known = rest.partition("-")
        counts = number.isascii() and number.isdecimal() and len(number) <= _DIGITS
        if word != "part" or not counts or path.suffix != ".parquet":
            raise PartError("is no part of a sweep")
        if int(number) >= self.source.num_chunks:
            raise PartError(f"is beyond the {self.source.num_chunks} parts of the run")
        with open_plain(path) as file:
            content = file.read()
        if f"{zlib.crc32(content):08x}" != known:
            raise PartError("is damaged: its checksum is not that of its name")
        try:
            with opened(pa.BufferReader(content)) as file:
                metadata, num_rows = file.schema_arrow.metadata or {}, file.metadata.num_rows
        except (pa.ArrowException, OSError):
            raise PartError("is not Parquet") from None
        record = parse_object(metadata.get(_RECORD, b"{}"))
        for name, wanted in self._own(int(number)).items():
            if record.get(name) != wanted:
                raise PartError(f"is of {name} {record.get(name)}, and not of {wanted}")
        sound = is_count(record.get("successes")) and isinstance(record.get("warm"), bool)
        if not sound or not all(is_number(record.get(name)) for name in _SECONDS):
            raise PartError("has no whole record")
        if num_rows != record["num"]:
            raise PartError(f"has {num_rows} rows, and not {record['num']}")
        return int(number), record
