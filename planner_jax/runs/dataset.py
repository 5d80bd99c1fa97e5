"""The rows of a run, one for each planned problem, as a Parquet dataset (for pandas, DuckDB).

A part is one file of rows, such as `part-000007-1a2b3c4d.parquet`, whose name holds its number and
its CRC-32 checksum. Its metadata hold a record: a JSON object with the number of rows, the times of
planning, and a digest of the settings and the code that made the rows.
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

from planner_jax.host.files import crc32_of, open_plain, replacing
from planner_jax.runs.manifest import Entries, Row

# Number of rows in one row group of a Parquet file, the smallest unit that can be read, about 3 MB.
ROW_GROUP = 2048
_LARGEST = 1 << 30  # [B] greatest size of a part that is read
_RECORD = b"part"  # key of a part's record in the metadata of its file
_NAME = re.compile(r"part-([0-9]{6,12})-([0-9a-f]{8})\.parquet")


class DamagedPart(ValueError):
    """Error: a file of rows is damaged or not part of a run; the message states the reason."""


def encode(rows: pa.Table, record: Mapping[str, object]) -> bytes:
    """Return the bytes of a Parquet file of `rows`, with the JSON object `record` as metadata."""
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
    """Return the number in the name of a file of rows; raise `DamagedPart` for other names."""
    if (name := _NAME.fullmatch(path.name)) is None:
        raise DamagedPart("is not a part of a run")
    return int(name[1])


def check_part(path: Path) -> Entries:
    """Return the JSON metadata of a file of rows; raise `DamagedPart` if the file is damaged."""
    number_of(path)
    with open_plain(path, _LARGEST) as file:
        if f"{crc32_of(file):08x}" != path.stem.rpartition("-")[2]:
            raise DamagedPart("is damaged: its checksum is not the one in its name")
        try:
            with pq.ParquetFile(file) as part:
                record = json.loads((part.schema_arrow.metadata or {})[_RECORD])
                return {**record, "num": part.metadata.num_rows}
        except (pa.ArrowException, OSError, KeyError, TypeError, ValueError):
            raise DamagedPart("is not a part of a run") from None


class Dataset:
    """All rows of a run, one for each planned problem, in the Parquet files (parts) of a folder."""

    def __init__(self, folder: Path):
        self.folder = folder

    def files(self) -> list[Path]:
        """Return the paths of all files in the folder except hidden files, sorted by name."""
        there = self.folder.iterdir() if self.folder.is_dir() else ()
        return sorted(path for path in there if not path.name.startswith("."))

    def write(self, number: int, content: bytes) -> None:
        """Write the row file with this number, and remove other files with the same number."""
        self.folder.mkdir(exist_ok=True)
        path = self.folder / f"part-{number:06d}-{zlib.crc32(content):08x}.parquet"
        with replacing(path) as scratch:
            scratch.write_bytes(content)
        for other in self.folder.glob(f"part-{number:06d}-*.parquet"):
            if other != path:
                other.unlink()

    def write_rows(self, rows: pa.Table) -> None:
        """Write a table as the only file of the dataset, part 0."""
        self.write(0, encode(rows, {}))

    def damages(self, num: int | None = None) -> dict[Path, str]:
        """Map damaged files to error texts, or the folder if only its row count is wrong."""
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
        """Return the named columns of all rows as one table; None returns all columns."""
        return self._open().to_table(columns=None if columns is None else list(columns))

    def parts(self, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """Yield a table for each file, of the named columns that the file has; None: of all."""
        for fragment in self._open().get_fragments():
            names = fragment.physical_schema.names
            known = None if columns is None else [name for name in columns if name in names]
            yield fragment.to_table(columns=known)

    def pick(self, rows: Sequence[int], columns: Sequence[str] | None = None) -> list[Row]:
        """Return the rows with the indices `rows`, sorted by index, without reading all rows."""
        wanted, first, picked = sorted(set(rows)), 0, []
        for fragment in self._open().get_fragments():
            for group in fragment.split_by_row_group():
                num = sum(info.num_rows for info in group.row_groups)
                local = [row - first for row in wanted if first <= row < first + num]
                if local:
                    picked += group.to_table(columns=columns).take(local).to_pylist()
                first += num
        return picked

    def _open(self) -> dataset.FileSystemDataset:
        return dataset.dataset([str(path) for path in self.files()], format="parquet")
