"""The rows of a run: a Parquet dataset, which `pyarrow.dataset`, pandas and DuckDB read.

A dataset is a folder with one file for each part, such as `part-000007-1a2b3c4d.parquet`, named by
the number of the part and the CRC-32 of the file. A part is written completely or not at all. Its
metadata hold a record of how its rows were made.
"""

import io
import json
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow import dataset

from planner_jax.host.files import open_plain, replacing
from planner_jax.runs.manifest import Entries, Row

ROW_GROUP = 2048  # rows of about 3 MB, the least that is read for one row
_RECORD = b"part"
_NAME = re.compile(r"part-([0-9]{6,12})-([0-9a-f]{8})\.parquet")


class DamagedPart(ValueError):
    """A file is not the part that was written; the text says why."""


def encode(rows: pa.Table, record: Mapping[str, object]) -> bytes:
    """Return the content of a part.

    Only text has a dictionary, because numbers hardly repeat. Lists are not compressed, which would
    save little.
    """
    metadata = {**(rows.schema.metadata or {}), _RECORD: json.dumps(record).encode()}
    text = [field.name for field in rows.schema if pa.types.is_string(field.type)]
    others = [field.name for field in rows.schema if not pa.types.is_list(field.type)]
    file = io.BytesIO()
    pq.write_table(
        rows.replace_schema_metadata(metadata),
        file,
        row_group_size=ROW_GROUP,
        compression=dict.fromkeys(others, "snappy"),  # pyright: ignore[reportArgumentType]
        use_dictionary=text,  # pyright: ignore[reportArgumentType]
        write_statistics=others,  # pyright: ignore[reportArgumentType]
    )
    return file.getvalue()


def number_of(path: Path) -> int:
    """Return the number in the name of a part; raise `DamagedPart` for another name."""
    if (name := _NAME.fullmatch(path.name)) is None:
        raise DamagedPart("is not a part of a run")
    return int(name[1])


def check_part(path: Path) -> Entries:
    """Return the record of a part; raise `DamagedPart` if the file is not what was written."""
    number_of(path)
    with open_plain(path) as file:
        content = file.read()
    if f"{zlib.crc32(content):08x}" != path.stem.rpartition("-")[2]:
        raise DamagedPart("is damaged: its checksum is not the one in its name")
    try:
        with pq.ParquetFile(pa.BufferReader(content)) as file:
            record = json.loads((file.schema_arrow.metadata or {})[_RECORD])
            return {**record, "num": file.metadata.num_rows}
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError):
        raise DamagedPart("is not a part of a run") from None


class Dataset:
    """The parts in a folder, in the order of their numbers.

    Args:
        folder: folder of the parts, which need not exist.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def files(self) -> list[Path]:
        """Return all files of the folder except hidden ones, sorted."""
        there = self.folder.iterdir() if self.folder.is_dir() else ()
        return sorted(path for path in there if not path.name.startswith("."))

    def write(self, number: int, content: bytes) -> None:
        """Write the content of a part, and remove other files of the same number."""
        self.folder.mkdir(exist_ok=True)
        path = self.folder / f"part-{number:06d}-{zlib.crc32(content):08x}.parquet"
        with replacing(path) as scratch:
            scratch.write_bytes(content)
        for other in self.folder.glob(f"part-{number:06d}-*.parquet"):
            if other != path:
                other.unlink()

    def write_rows(self, rows: pa.Table) -> None:
        """Write rows as the only part."""
        self.write(0, encode(rows, {}))

    def damages(self, num: int | None = None) -> dict[Path, str]:
        """Return a text on each damaged file; for a wrong number of rows, on the folder."""
        found, counted = {}, 0
        for place, path in enumerate(self.files()):
            try:
                counted += check_part(path)["num"]
                if number_of(path) != place:
                    raise DamagedPart(f"stands in the place of part {place}")
            except DamagedPart as error:
                found[path] = str(error)
            except OSError as error:
                found[path] = f"cannot be read: {error.strerror}"
        if not found and num not in (None, counted):
            found[self.folder] = f"has {counted} rows, and not {num}"
        return found

    def read(self, columns: Sequence[str] | None = None) -> pa.Table:
        """Return some columns, by default all, of all rows."""
        return self._open().to_table(columns=None if columns is None else list(columns))

    def parts(self, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """Yield the rows part by part."""
        for fragment in self._open().get_fragments():
            names = fragment.physical_schema.names
            known = None if columns is None else [name for name in columns if name in names]
            yield fragment.to_table(columns=known)

    def pick(self, rows: Sequence[int], columns: Sequence[str] | None = None) -> list[Row]:
        """Return the rows with some indices, in ascending order; read only their row groups."""
        wanted, first, picked = sorted(set(rows)), 0, []
        for fragment in self._open().get_fragments():
            size = fragment.metadata.num_rows
            if any(first <= row < first + size for row in wanted):
                for group in fragment.split_by_row_group():
                    num = sum(info.num_rows for info in group.row_groups)
                    local = [row - first for row in wanted if first <= row < first + num]
                    if local:
                        picked += group.to_table(columns=columns).take(local).to_pylist()
                    first += num
            else:
                first += size
        return picked

    def _open(self) -> dataset.FileSystemDataset:
        return dataset.dataset([str(path) for path in self.files()], format="parquet")
