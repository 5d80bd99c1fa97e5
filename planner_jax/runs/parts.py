"""The parts of a sweep: the rows of one chunk each, in `parts/` until all are joined.

A part is encoded where its rows are made, and written by the process that knows of the run. What
is joined are its pages as they are.

A part is checked, not trusted. Its name holds the checksum of the file; its metadata say of which
run it is, made by what, of which settings, and which rows it holds. What does not agree is removed
with a word on the standard error stream, and its cases are planned again.
"""

import dataclasses
import errno
import json
import sys
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from planner_jax.host.files import open_plain, replacing
from planner_jax.runs.joined_parquet import (
    JoinError,
    ParquetParts,
    parquet_parts,
    write_in_blocks,
)
from planner_jax.runs.manifest import FORMAT, is_count, is_number
from planner_jax.runs.parquet import encoded, opened
from planner_jax.runs.plain_json import JsonError, parse_object
from planner_jax.runs.run_folder import RunFolder
from planner_jax.runs.settings import SettingError
from planner_jax.runs.source import Source

_RECORD = b"part"
_DIGITS = 12  # of a part's number, at most
_SECONDS = ("plan_seconds", "compile_seconds", "referee_seconds", "wall_seconds")


class PartError(ValueError):
    """A file is not a part of the run; a few words that say why."""


@dataclasses.dataclass(frozen=True)
class EncodedRows:
    """The rows of a chunk as they are written, and those columns that are counted."""

    counted: pa.Table
    file: ParquetParts  # without a record
    crc32: int  # of its pages

    @classmethod
    def of(cls, rows: pa.Table, counted: Sequence[str]) -> "EncodedRows":
        """Encode rows.

        Args:
            rows: of a chunk.
            counted: names of columns, if they are there; none: all are counted.
        """
        names = [name for name in rows.column_names if name in (counted or rows.column_names)]
        file = parquet_parts(encoded(rows))
        return cls(rows.select(names), file, zlib.crc32(file.pages))


@dataclasses.dataclass(frozen=True)
class Part:
    """A part that is sound."""

    path: Path
    record: dict[str, Any]  # how its rows came about

    def read(self, counted: Sequence[str]) -> EncodedRows:
        """Its rows.

        Args:
            counted: as of `EncodedRows.of`.

        Raises:
            OSError: it is not what it was when it was found sound.
        """
        with open_plain(self.path) as file:
            content = file.read()
        if f"{zlib.crc32(content):08x}" != _sum_of(self.path):
            raise OSError(errno.EIO, "it was damaged while the run was resumed", str(self.path))
        with opened(pa.BufferReader(content)) as file:
            rows = file.read(list(counted) or None)
        parts = parquet_parts(content).without(_RECORD)
        return EncodedRows(rows, parts, zlib.crc32(parts.pages))


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

    def write(self, number: int, rows: EncodedRows, record: dict[str, Any]) -> dict[str, Any]:
        """Write the rows of a chunk; gives the record of how they came about as it is kept."""
        self.folder.mkdir(exist_ok=True)
        record = {**self._own(number), **record}
        ending = rows.file.ending({**rows.file.metadata, _RECORD: json.dumps(record).encode()})
        name = f"part-{number:06d}-{zlib.crc32(ending, rows.crc32):08x}.parquet"
        with replacing(self.folder / name) as scratch, open(scratch, "wb") as file:
            write_in_blocks(file, rows.file.pages)
            file.write(ending)
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
        number, *_ = rest.partition("-")
        counts = number.isascii() and number.isdecimal() and len(number) <= _DIGITS
        if word != "part" or not counts or path.suffix != ".parquet":
            raise PartError("is no part of a sweep")
        if int(number) >= self.source.num_chunks:
            raise PartError(f"is beyond the {self.source.num_chunks} parts of the run")
        with open_plain(path) as file:
            content = file.read()
        if f"{zlib.crc32(content):08x}" != _sum_of(path):
            raise PartError("is damaged: its checksum is not that of its name")
        try:
            file = parquet_parts(content)
        except JoinError as error:
            raise PartError(str(error)) from None
        record = parse_object(file.metadata.get(_RECORD, b"{}"))
        for name, wanted in self._own(int(number)).items():
            if record.get(name) != wanted:
                raise PartError(f"is of {name} {record.get(name)}, and not of {wanted}")
        sound = is_count(record.get("successes")) and isinstance(record.get("warm"), bool)
        if not sound or not all(is_number(record.get(name)) for name in _SECONDS):
            raise PartError("has no whole record")
        if file.num_rows != record["num"]:
            raise PartError(f"has {file.num_rows} rows, and not {record['num']}")
        return int(number), record


def _sum_of(path: Path) -> str:
    """The checksum of a part, as its name has it."""
    return path.stem.partition("-")[2].partition("-")[2]
