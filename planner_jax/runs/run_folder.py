"""The folder that a run writes: manifest, rows, table, figures and page.

Everything appears whole: files are written beside their place and renamed into it, so that a
run which was killed at any moment can be resumed. One process writes at a time.
"""

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa

from planner_jax.host.files import is_scratch, replacing
from planner_jax.runs import manifest as manifests
from planner_jax.runs.joined_parquet import ParquetJoiner, ParquetParts
from planner_jax.runs.owner import LOCK, owned, require_free
from planner_jax.runs.parquet import file_sum, write_rows
from planner_jax.runs.settings import SettingError

MANIFEST = "manifest.json"


class RunFolder:
    """One run's folder: `manifest.json`, `plans.parquet`, and `parts/` while it is under way.

    Args:
        path: of the folder, which need not exist.
        name: of the caller's argument that holds the path, for messages.
    """

    def __init__(self, path: str | os.PathLike, name: str = "out"):
        self.name = name
        self.path = Path(path)
        self.shown = str(path)  # in messages
        self.plans = self.path / "plans.parquet"
        self.baselines = self.path / "baselines.parquet"
        self.figures = self.path / "figures"
        self.parts = self.path / "parts"
        self._manifest = self.path / MANIFEST
        self._made: list[Path] = []
        self._sums: dict[str, dict[str, int]] = {}  # of files written since the manifest was

    def require_new(self) -> None:
        """Raise `SettingError` unless a run may be written here; writes nothing."""
        try:
            require_free(self.path, self.name)
            if self.path.is_dir() and not all(map(_is_left, self.path.iterdir())):
                rule = "a new or empty folder"
                if self._manifest.exists():
                    rule += ", or that of a run with resume"
                raise SettingError(f"{self.name} must be {rule}, got {self.shown!r}")
            ancestor = next(p for p in [self.path, *self.path.absolute().parents] if p.exists())
        except OSError as error:  # such as a name that is too long
            raise SettingError(f"{self._unwritable()} ({error.strerror})") from None
        if not ancestor.is_dir() or not os.access(ancestor, os.W_OK | os.X_OK):
            raise SettingError(self._unwritable())

    @contextlib.contextmanager
    def created(self, manifest: dict[str, Any]) -> Iterator[None]:
        """Make the folder with its first manifest, and own it for the length of the block.

        Raises:
            SettingError: the folder cannot be made, or is not new any more.
        """
        self._made = [p for p in [self.path, *self.path.absolute().parents] if not p.exists()]
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            self._remove_made()
            raise SettingError(f"{self._unwritable()} ({error.strerror})") from None
        with self._owned():
            if not all(map(_is_left, self.path.iterdir())):  # another process was quicker
                rule = "a new or empty folder"
                raise SettingError(f"{self.name} must be {rule}, got {self.shown!r}")
            self._remove_left()
            try:
                self.write_manifest(manifest)
            except OSError as error:
                self.discard()
                raise SettingError(f"{self._unwritable()} ({error.strerror})") from None
            yield

    @contextlib.contextmanager
    def begun(self) -> Iterator[None]:
        """Make the folder if it is not there, and own it for the length of the block.

        Raises:
            SettingError: it cannot be made or written, or another process owns it.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SettingError(f"{self._unwritable()} ({error.strerror})") from None
        with self.resumed():
            yield

    @contextlib.contextmanager
    def resumed(self) -> Iterator[None]:
        """Own the folder of a run for the length of the block.

        Raises:
            SettingError: another process does, or it cannot be written.
        """
        with self._owned():
            self._remove_left()
            yield

    def sent(self, path: Path) -> None:
        """What is done once a file of the folder is whole; here nothing."""

    def dropped(self, path: Path) -> None:
        """Remove a file of the folder."""
        path.unlink(missing_ok=True)

    def _owned(self) -> contextlib.AbstractContextManager[None]:
        """Owns the folder for the length of a block."""
        return owned(self.path, self.name)

    def _unwritable(self) -> str:
        return f"{self.name} must be a folder that can be written, got {self.shown!r}"

    def discard(self) -> None:
        """Remove all that was written since `created`, and the folders made for it."""
        for path in self.path.iterdir() if self.path.is_dir() else ():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        self._remove_made()

    def _remove_made(self) -> None:
        for folder in self._made:
            try:
                folder.rmdir()
            except OSError:
                return

    def _remove_left(self) -> None:
        """Drop what a killed process was writing."""
        for folder in (self.path, self.parts, self.figures):
            for path in folder.iterdir() if folder.is_dir() else ():
                if is_scratch(path):
                    path.unlink(missing_ok=True)

    def read_manifest(self) -> dict[str, Any]:
        """The manifest.

        Raises:
            SettingError: the folder is not that of a run, or its manifest is not sound.
        """
        return manifests.read_manifest(self._manifest, self.name, self.shown)

    def write_manifest(self, manifest: dict[str, Any]) -> dict[str, Any]:
        """Put a manifest, with the sums of files, in the place of the old one; as it is written."""
        whole = self.with_sums(manifest)
        self.write_text(MANIFEST, json.dumps(whole, indent=2, allow_nan=False) + "\n")
        return whole

    def with_sums(self, manifest: dict[str, Any]) -> dict[str, Any]:
        """A manifest as `write_manifest` writes it."""
        sums = {**manifest.get("files", {}), **self._sums}
        return manifests.to_write({**manifest, "files": sums} if sums else manifest)

    def write_text(self, name: str, text: str) -> None:
        """Write a file of the folder whole."""
        with replacing(self.path / name) as scratch:
            scratch.write_text(text, encoding="utf-8")
        self.sent(self.path / name)

    def damages(self, manifest: dict[str, Any]) -> dict[str, str]:
        """What is wrong with the files whose sums a manifest holds: words by file, if any."""
        found = {}
        for name, wanted in manifest.get("files", {}).items():
            try:
                if file_sum(self.path / name) != wanted:
                    found[name] = "damaged: its checksum is not that of its manifest"
            except OSError as error:
                found[name] = (
                    "missing" if isinstance(error, FileNotFoundError) else str(error.strerror)
                )
        return found

    def require_finished(self, manifest: dict[str, Any]) -> None:
        """Raise `SettingError` unless a sweep has its summary and all its rows."""
        if "summary" not in manifest or not self.plans.exists():
            rule = f"{self.name} must be finished"
            raise SettingError(f"{rule}, got {self.shown!r}; resume it first")

    def require_whole(self, manifest: dict[str, Any], remedy: str) -> None:
        """Raise `SettingError` if a file of the run is missing or damaged.

        Args:
            manifest: of the run.
            remedy: what to do then, in words.
        """
        for name, why in self.damages(manifest).items():
            rule = f"a run whose {name} is whole"
            shown = f"{self.shown!r}, where it is {why}; {remedy}"
            raise SettingError(f"{self.name} must be {rule}, got {shown}")

    @contextlib.contextmanager
    def joining_parts(self) -> Iterator[Callable[[ParquetParts], None]]:
        """A function that adds the rows of a part to `plans.parquet`, as they are encoded.

        The file is there once the block has ended well, and the parts are then needed no more.
        """
        with replacing(self.plans) as scratch:
            with open(scratch, "wb") as file:
                joiner = ParquetJoiner(file)
                yield joiner.add
                joiner.end()
            self._sums[self.plans.name] = file_sum(scratch)
        self.sent(self.plans)

    def remove_parts(self) -> None:
        """Drop what `joining_parts` has joined."""
        shutil.rmtree(self.parts, ignore_errors=True)

    def write_rows(self, path: Path, rows: pa.Table) -> None:
        """Write a Parquet file of the folder whole."""
        with replacing(path) as scratch:
            write_rows(rows, scratch)
            self._sums[path.name] = file_sum(scratch)
        self.sent(path)


def _is_left(path: Path) -> bool:
    """Whether a file is what a process leaves that was killed before it had a manifest."""
    return path.name == LOCK or is_scratch(path)
