"""Parquet files of runs: with checksums of their pages, which are verified when they are read."""

import io
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from planner_jax.host.files import open_plain

ROW_GROUP = 2048  # rows, some 3 MB: little has to be read for one of them
_BLOCK = 1 << 20  # bytes


def _encoding(schema: pa.Schema) -> dict[str, Any]:
    """How rows are written.

    Numbers hardly repeat: only text is worth a dictionary, and lists are not worth squeezing.
    """
    text = [field.name for field in schema if pa.types.is_string(field.type)]
    lists = {field.name for field in schema if pa.types.is_list(field.type)}
    others = [field.name for field in schema if field.name not in lists]
    return {
        # Columns of lists have longer names in the file; what is not named is not squeezed.
        "compression": dict.fromkeys(others, "snappy"),
        "use_dictionary": text,
        "write_statistics": others,
        "write_page_checksum": True,
    }


class _Pieces(io.RawIOBase):
    """A file in memory, as the pieces that were written: one block would be moved as it grows."""

    def __init__(self) -> None:
        self.pieces: list[Any] = []

    def writable(self) -> bool:
        return True

    def write(self, piece: Any) -> int:
        self.pieces.append(piece)
        return len(piece)


def write_rows(rows: pa.Table, where: Any) -> None:
    """Write a Parquet file of rows: to a path, or into what bytes can be written to."""
    pq.write_table(rows, where, row_group_size=ROW_GROUP, **_encoding(rows.schema))


def encoded(rows: pa.Table) -> bytes:
    """The content of a Parquet file of rows; of the same rows it is the same."""
    written = _Pieces()
    write_rows(rows, written)
    return b"".join(written.pieces)


def file_sum(path: Path) -> dict[str, int]:
    """Size and CRC-32 of a file, by which its damage is known.

    Raises:
        OSError: it cannot be read.
    """
    size, found = 0, 0
    with open_plain(path) as file:
        while block := file.read(_BLOCK):
            size, found = size + len(block), zlib.crc32(block, found)
    return {"bytes": size, "crc32": found}


def opened(source: Any) -> pq.ParquetFile:
    """A Parquet file or its bytes; whoever reads a page of a wrong checksum is told.

    Raises:
        pa.ArrowException, OSError: it cannot be read.
    """
    if isinstance(source, Path):
        open_plain(source).close()
    return pq.ParquetFile(source, page_checksum_verification=True)


def read_rows(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Some columns, by default all, of all rows of a file."""
    with opened(path) as file:
        return file.read(columns=None if columns is None else list(columns))


def row_groups(path: Path, columns: Sequence[str] | None = None) -> Iterator[tuple[int, pa.Table]]:
    """The rows of a file, some at a time, each with the place of the first one."""
    first = 0
    with opened(path) as file:
        for group in range(file.num_row_groups):
            rows = file.read_row_group(group, columns=columns)
            yield first, rows
            first += rows.num_rows


def pick_rows(
    path: Path, rows: Sequence[int], columns: Sequence[str] | None = None
) -> list[dict[str, Any]]:
    """Some rows of a Parquet file as dictionaries, in order; one row group in memory at a time."""
    wanted, first, picked = sorted(set(rows)), 0, []
    with opened(path) as file:
        for group in range(file.num_row_groups):
            size = file.metadata.row_group(group).num_rows
            local = [row - first for row in wanted if first <= row < first + size]
            if local:
                picked += file.read_row_group(group, columns=columns).take(local).to_pylist()
            first += size
    return picked
