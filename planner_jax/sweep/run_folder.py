"""The folder that a run writes: manifest, rows, table, figures and page.

Everything appears whole: files are written beside their place and renamed into it, so that a
run which was killed at any moment can be resumed.
"""

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from planner_jax.sweep.settings import SettingError

_PART_RECORD = b"part"
_ROW_GROUP = 2048  # rows, some 3 MB: little has to be read for one of them
_MANIFEST_KEYS = {"kind", "state", "parameters"}


class RunFolder:
    """One run's folder: `manifest.json`, `plans.parquet`, and `parts/` while it is under way.

    Args:
        path: of the folder, which need not exist.
        name: of the caller's argument that holds the path, for messages.
    """

    def __init__(self, path: str | os.PathLike, name: str = "out"):
        self.name = name
        self.path = Path(path)
        self.plans = self.path / "plans.parquet"
        self.baselines = self.path / "baselines.parquet"
        self.figures = self.path / "figures"
        self._manifest = self.path / "manifest.json"
        self._parts = self.path / "parts"
        self._made: list[Path] = []

    def require_new(self) -> None:
        """Raise `SettingError` unless a run may be written here; writes nothing."""
        if self.path.is_dir() and any(self.path.iterdir()):
            rule = "a new or empty folder"
            if self._manifest.exists():
                rule += ", or that of a run with resume"
            raise SettingError(f"{self.name} must be {rule}, got {str(self.path)!r}")
        ancestor = next(p for p in [self.path, *self.path.absolute().parents] if p.exists())
        if not ancestor.is_dir() or not os.access(ancestor, os.W_OK | os.X_OK):
            raise SettingError(self._unwritable())

    def create(self, manifest: dict[str, Any]) -> None:
        """Make the folder with its first manifest.

        Raises:
            SettingError: the folder cannot be made.
        """
        self._made = [p for p in [self.path, *self.path.absolute().parents] if not p.exists()]
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self.write_manifest(manifest)
        except OSError as error:
            self.discard()
            raise SettingError(f"{self._unwritable()} ({error.strerror})") from None

    def _unwritable(self) -> str:
        return f"{self.name} must be a folder that can be written, got {str(self.path)!r}"

    def discard(self) -> None:
        """Undo `create` and the parts written since."""
        self.remove_parts()
        self._manifest.unlink(missing_ok=True)
        for folder in self._made:
            try:
                folder.rmdir()
            except OSError:
                return

    def read_manifest(self) -> dict[str, Any]:
        """The manifest.

        Raises:
            SettingError: the folder is not that of a run.
        """
        try:
            manifest = json.loads(self._manifest.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            manifest = None
        if not isinstance(manifest, dict) or not _MANIFEST_KEYS <= manifest.keys():
            raise SettingError(
                f"{self.name} must be the folder of a run, with its manifest.json, "
                f"got {str(self.path)!r}"
            )
        return manifest

    def write_manifest(self, manifest: dict[str, Any]) -> None:
        """Put a manifest in the place of the old one."""
        text = json.dumps(manifest, indent=2, allow_nan=False)
        self.write_text("manifest.json", text + "\n")

    def write_text(self, name: str, text: str) -> None:
        """Write a file of the folder whole."""
        with _replacing(self.path / name) as scratch:
            scratch.write_text(text, encoding="utf-8")

    def write_part(self, number: int, rows: pa.Table, record: dict[str, Any]) -> None:
        """Write the rows of one chunk, and a record of how they came about."""
        self._parts.mkdir(exist_ok=True)
        metadata = {**(rows.schema.metadata or {}), _PART_RECORD: json.dumps(record).encode()}
        self.write_rows(self._part(number), rows.replace_schema_metadata(metadata))

    def part_record(self, number: int) -> dict[str, Any] | None:
        """The record of a part that is there; None for one that is not."""
        try:
            metadata = pq.read_schema(self._part(number)).metadata
        except FileNotFoundError:
            return None
        return json.loads(metadata[_PART_RECORD])

    def read_part(self, number: int) -> pa.Table:
        """The rows of a part that is there."""
        rows = pq.read_table(self._part(number))
        kept = {key: value for key, value in rows.schema.metadata.items() if key != _PART_RECORD}
        return rows.replace_schema_metadata(kept)

    @contextlib.contextmanager
    def joining_parts(self) -> Iterator[Callable[[pa.Table], None]]:
        """A function that adds the rows of a part to `plans.parquet`.

        The file is there once the block has ended well, and the parts are then needed no more.
        """
        writer: pq.ParquetWriter | None = None

        def join(rows: pa.Table) -> None:
            nonlocal writer
            if writer is None:
                writer = pq.ParquetWriter(scratch, rows.schema, **_encoding(rows.schema))
            writer.write_table(rows, row_group_size=_ROW_GROUP)

        with _replacing(self.plans) as scratch:
            try:
                yield join
            finally:
                if writer is not None:
                    writer.close()

    def remove_parts(self) -> None:
        """Drop what `joining_parts` has joined."""
        shutil.rmtree(self._parts, ignore_errors=True)

    def write_rows(self, path: Path, rows: pa.Table) -> None:
        """Write a Parquet file whole."""
        with _replacing(path) as scratch:
            pq.write_table(rows, scratch, row_group_size=_ROW_GROUP, **_encoding(rows.schema))

    def _part(self, number: int) -> Path:
        return self._parts / f"part-{number:06d}.parquet"


class _replacing:
    """A scratch file that takes the place of `path` once its block has ended well."""

    def __init__(self, path: Path):
        self.path = path
        self.scratch = path.with_name(f".{path.name}.tmp")

    def __enter__(self) -> Path:
        return self.scratch

    def __exit__(self, kind: Any, *_: Any) -> None:
        if kind is None:
            os.replace(self.scratch, self.path)
        else:
            self.scratch.unlink(missing_ok=True)


def _encoding(schema: pa.Schema) -> dict[str, Any]:
    """Numbers hardly repeat: only text is worth a dictionary, and lists are not worth squeezing."""
    text = [field.name for field in schema if pa.types.is_string(field.type)]
    lists = {field.name for field in schema if pa.types.is_list(field.type)}
    others = [field.name for field in schema if field.name not in lists]
    return {
        # Columns of lists have longer names in the file; what is not named is not squeezed.
        "compression": dict.fromkeys(others, "snappy"),
        "use_dictionary": text,
        "write_statistics": others,
    }


def pick_rows(
    path: Path, rows: Sequence[int], columns: Sequence[str] | None = None
) -> list[dict[str, Any]]:
    """Some rows of a Parquet file as dictionaries, in order; one row group in memory at a time."""
    wanted, first, picked = sorted(set(rows)), 0, []
    with pq.ParquetFile(path) as file:
        for group in range(file.num_row_groups):
            size = file.metadata.row_group(group).num_rows
            local = [row - first for row in wanted if first <= row < first + size]
            if local:
                picked += file.read_row_group(group, columns=columns).take(local).to_pylist()
            first += size
    return picked
