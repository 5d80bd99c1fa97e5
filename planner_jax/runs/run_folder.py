"""The folder of a run, many planned and judged problems: manifest, rows, figures, HTML page.

Each file is written under a scratch name and renamed when it is complete, so that a killed run can
be resumed. Only the process that holds a lock on the file `.lock` writes to the folder.
"""

import contextlib
import dataclasses
import datetime
import errno
import fcntl
import json
import os
import re
import shutil
import socket
import stat
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.host.files import is_scratch, replacing
from planner_jax.runs.dataset import Dataset
from planner_jax.runs.manifest import MANIFEST, Entries, Row, read_written, to_write

LOCK = ".lock"
# Greatest number of rejected plans, and number of all plans, that one figure of a run shows.
FAILURES_SHOWN, _CASES_SHOWN = 12, 60
_OWNER = re.compile(r"[0-9]+ on .*, since [0-9T:+-]+")  # text of the lock
_TRIES, _BETWEEN = 20, 0.01  # number of attempts to take the lock, and [s] pause between attempts


class RunFolder:
    """The folder `path` of one run; error messages call it `name`, such as "out"."""

    def __init__(self, path: str | os.PathLike, name: str = "out"):
        self.name = name
        self.path = Path(path)
        try:
            str(self.path).encode()
        except UnicodeEncodeError:  # Parquet files are opened by names in UTF-8
            raise ArgumentError(name, "a path in UTF-8", shown=ascii(str(path))) from None
        self.plans = Dataset(self.path / "plans")
        self.baselines = Dataset(self.path / "baselines")
        self.figures = self.path / "figures"
        self._made: list[Path] = []

    def require(self, holds: bool, rule: str, shown: str) -> None:
        """Raise an error that the folder must be `rule` but is `shown` unless `holds` is true."""
        require(holds, self.name, rule, shown=shown)

    def require_new(self) -> None:
        """Raise `ArgumentError` unless a new run can be written to this path; write nothing."""
        try:
            if os.path.lexists(self.path / LOCK):
                with self._hold_lock(os.O_RDONLY, fcntl.LOCK_SH):
                    pass
            if self.path.is_dir():
                self._require_empty()
            ancestor = next(p for p in [self.path, *self.path.absolute().parents] if p.exists())
        except OSError as error:  # for example because the path is too long
            raise self._unwritable(error) from None
        if not ancestor.is_dir() or not os.access(ancestor, os.W_OK | os.X_OK):
            raise self._unwritable()

    @contextlib.contextmanager
    def create(self, manifest: Entries) -> Iterator[None]:
        """Create the folder with its first manifest, and hold the lock within the `with` block."""
        self._made = [p for p in [self.path, *self.path.absolute().parents] if not p.exists()]
        with self.lock():
            self._require_empty()  # another process may have written a run since `require_new`
            try:
                self.write_manifest(manifest)
            except OSError as error:
                self.discard()
                raise self._unwritable(error) from None
            yield

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the folder's lock within the block; raise if another process holds the lock."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            self._remove_made()
            raise self._unwritable(error) from None
        with self._hold_lock(os.O_RDWR | os.O_CREAT, fcntl.LOCK_EX) as handle:
            for folder in self._folders():
                rule = f"a folder whose {folder.name} is no link to another folder"
                self.require(not folder.is_symlink(), rule, repr(str(self.path)))
            since = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
            owner = f"{os.getpid()} on {socket.gethostname()}, since {since}"
            try:
                os.ftruncate(handle, 0)
                os.pwrite(handle, owner.encode(), 0)
            except OSError as error:
                raise self._unwritable(error) from None
            self._remove_scratch()
            yield

    @contextlib.contextmanager
    def _hold_lock(self, flags: int, kind: int) -> Iterator[int]:
        """Hold a lock of the kind `fcntl.LOCK_*` on the file `.lock`; provide the open file."""
        lock = self.path / LOCK
        with contextlib.ExitStack() as opened:
            try:
                if os.path.lexists(lock) and not stat.S_ISREG(lock.lstat().st_mode):
                    raise OSError(errno.EINVAL, f"its {LOCK} is no plain file")
                handle = os.open(lock, flags | os.O_NONBLOCK | os.O_NOFOLLOW, 0o644)
                opened.callback(os.close, handle)
                self._acquire(handle, kind)
            except OSError as error:
                raise self._unwritable(error) from None
            yield handle

    def _acquire(self, handle: int, kind: int) -> None:
        """Lock an open file; raise if another process holds it or another program wrote it."""
        is_locked = False
        for _ in range(_TRIES):
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(handle, kind | fcntl.LOCK_NB)
                is_locked = True
                break
            time.sleep(_BETWEEN)
        owner = os.pread(handle, 1000, 0).decode(errors="replace")
        rule = f"a folder without the {LOCK} of another program"
        self.require(not owner or bool(_OWNER.fullmatch(owner)), rule, repr(str(self.path)))
        shown = f"{str(self.path)!r}, owned by process {owner}"
        self.require(is_locked, "a folder that no other process writes", shown)

    def _unwritable(self, error: OSError | None = None) -> ArgumentError:
        why = f" ({error.strerror})" if error else ""
        rule = "a folder that can be written"
        return ArgumentError(self.name, rule, shown=f"{str(self.path)!r}{why}")

    def _require_empty(self) -> None:
        if not all(path.name == LOCK or is_scratch(path) for path in self.path.iterdir()):
            rule = "a new or empty folder"
            if (self.path / MANIFEST).exists():
                rule += ", or the folder of a run with resume"
            raise ArgumentError(self.name, rule, str(self.path))

    def discard(self) -> None:
        """Remove all files of the folder, and the folders that this object created."""
        for path in self.path.iterdir() if self.path.is_dir() else ():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        self._remove_made()

    def _remove_made(self) -> None:
        with contextlib.suppress(OSError):
            for folder in self._made:
                folder.rmdir()

    def _folders(self) -> tuple[Path, ...]:
        return self.plans.folder, self.baselines.folder, self.figures

    def _remove_scratch(self) -> None:
        for folder in (self.path, *self._folders()):
            for path in folder.iterdir() if folder.is_dir() else ():
                if is_scratch(path):
                    path.unlink(missing_ok=True)

    def read_manifest(self) -> Entries:
        """Read the run's `manifest.json`; raise `ArgumentError` if missing, edited or damaged."""
        return read_written(self.path / MANIFEST, self.name, "a run")

    def write_manifest(self, manifest: Entries) -> Entries:
        """Replace the run's `manifest.json`, and return the JSON object that it then holds."""
        text = json.dumps(to_write(manifest), indent=2, allow_nan=False)
        self.write_text(MANIFEST, text + "\n")
        return json.loads(text)

    def write_text(self, name: str, text: str) -> None:
        """Write a text file atomically; `name` is its path within the folder."""
        with replacing(self.path / name) as scratch:
            scratch.write_text(text, encoding="utf-8")

    @contextlib.contextmanager
    def reading_rows(self) -> Iterator[None]:
        """Convert errors of reading rows within the `with` block to `ArgumentError`."""
        errors = (pa.ArrowException, LookupError, OSError, TypeError, ValueError, ZeroDivisionError)
        try:
            yield
        except errors as error:
            rule, why = "a run whose rows can be read", " ".join(str(error).split())
            raise ArgumentError(self.name, rule, shown=why) from None

    def require_whole(self, rows: Dataset, remedy: str, num: int | None = None) -> None:
        """Raise an error with advice `remedy` if a file is damaged or there are not `num` rows."""
        for path, why in rows.damages(num).items():
            rule = f"a run whose {path.relative_to(self.path)} is whole"
            shown = f"{str(self.path)!r}, where it {why}; {remedy}"
            raise ArgumentError(self.name, rule, shown=shown)


@dataclasses.dataclass(frozen=True)
class RunRows:
    """Manifest of a finished run and its rows, one for each planned problem, for the figures."""

    folder: RunFolder
    manifest: Entries
    failures: list[Row]  # the first rows whose plans the referee rejected

    def sample(self) -> list[Row]:
        """Return about 60 evenly spaced rows for figures, with further rejected plans up to 12."""
        last = self.manifest["summary"]["num"] - 1
        spread = np.linspace(0, last, _CASES_SHOWN).astype(int).tolist()
        shown = self.folder.plans.pick(spread)
        missing = FAILURES_SHOWN - sum(not row["success"] for row in shown)
        others = [row for row in self.failures if row["index"] not in spread]
        return shown + others[: max(missing, 0)]

    def same_case(self) -> list[tuple[str, Row]]:
        """Return (planner's name, row) of each plan of the example case that figures show.

        The run's own planner comes first, then other planners that planned the case to compare.
        """
        own = self.folder.plans.pick([self.manifest["example"]])[0]
        others = self.folder.baselines
        rows = others.read().to_pylist() if others.files() else []
        name = self.manifest["parameters"]["planner"]
        return [(name, own), *((row["planner"], row) for row in rows)]
