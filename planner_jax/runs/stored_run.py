"""Runs in an object store: made in a folder of this machine, each file sent once it is whole.

A store has no locks. Who writes a run there says so in an object, its lease, which is renewed as
long as the process lives, and removed when it ends. A lease counts no more once it has run out, or
when it is of a process of this machine that is gone.
"""

import contextlib
import datetime
import json
import os
import shutil
import socket
import tempfile
import threading
import time
import uuid
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from planner_jax.runs.bucket import Bucket, bucket_of
from planner_jax.runs.run_folder import MANIFEST, RunFolder
from planner_jax.runs.settings import SettingError, is_address

LEASE = "lease.json"
_LASTS, _RENEWED = 300.0, 60.0  # [s], a lease, and how often it is renewed
_SEEN: set[str] = set()  # addresses where this process has read or written a manifest


def run_folder(out: str | os.PathLike, name: str = "out") -> RunFolder:
    """The folder of a run on the disk, or in an object store.

    Args:
        out: a path, or an address s3://BUCKET/PATH.
        name: of the caller's argument that holds it, for messages.

    Raises:
        SettingError: the address is none.
        OSError: the store does not answer.
    """
    if not is_address(out):
        return RunFolder(out, name)
    try:
        return StoredRunFolder(bucket_of(str(out), name), name)
    except ValueError as error:
        raise SettingError(str(error)) from None


def has_begun(out: str) -> bool:
    """Whether there is a manifest of a run, as far as that can be said without asking a store."""
    return out.rstrip("/") in _SEEN if is_address(out) else (Path(out) / MANIFEST).exists()


class StoredRunFolder(RunFolder):
    """A run in an object store, and the folder of this machine where its files are made.

    Args:
        bucket: the place in the store.
        name: of the caller's argument that holds its address, for messages.
    """

    def __init__(self, bucket: Bucket, name: str = "out"):
        desk = tempfile.mkdtemp(prefix="planner-jax-")
        self._clear = weakref.finalize(self, shutil.rmtree, desk, ignore_errors=True)
        super().__init__(desk, name)
        self.shown, self.bucket, self._is_owner = bucket.address, bucket, False

    def require_new(self) -> None:
        """Raise `SettingError` unless nothing lies at the address; writes nothing."""
        self._require_free()
        if names := set(self.bucket.names()) - {LEASE}:
            rule = "a new or empty folder"
            if MANIFEST in names:
                rule += ", or that of a run with resume"
            raise SettingError(f"{self.name} must be {rule}, got {self.shown!r}")
        _SEEN.discard(self.shown)

    def read_manifest(self) -> dict[str, Any]:
        """The manifest.

        Raises:
            SettingError: there is none, or it is not sound.
            OSError: the store does not answer.
        """
        if not self._is_owner:
            self._fetch(MANIFEST)
        manifest = super().read_manifest()
        _SEEN.add(self.shown)
        return manifest

    def sent(self, path: Path) -> None:
        """Put a file that is whole into the store."""
        name = path.relative_to(self.path).as_posix()
        self.bucket.send(name, path)
        if name == MANIFEST:
            _SEEN.add(self.shown)

    def dropped(self, path: Path) -> None:
        """Remove a file of the run, here and in the store."""
        self.bucket.remove(path.relative_to(self.path).as_posix())
        super().dropped(path)

    def remove_parts(self) -> None:
        """Drop what has been joined."""
        self._remove(lambda name: name.startswith("parts/"))
        super().remove_parts()

    def discard(self) -> None:
        """Remove all that was written."""
        self._remove(lambda name: name != LEASE)
        _SEEN.discard(self.shown)
        super().discard()

    def _remove(self, is_meant: Any) -> None:
        for name in filter(is_meant, self.bucket.names()):
            self.bucket.remove(name)

    def _fetch(self, name: str) -> None:
        """Bring a file here, or nothing where there is none."""
        if (content := self.bucket.read(name)) is not None:
            (self.path / name).parent.mkdir(exist_ok=True)
            (self.path / name).write_bytes(content)

    @contextlib.contextmanager
    def _owned(self) -> Iterator[None]:
        """Hold the lease, with everything of the run brought here, for the length of a block."""
        self._require_free()
        mine = uuid.uuid4().hex
        self._claim(mine)
        if (self._lease() or {}).get("token") != mine:  # another was quicker
            self._require_free()
        ended = threading.Event()
        keeper = threading.Thread(target=self._renew, args=(mine, ended), daemon=True)
        keeper.start()
        try:
            for name in self.bucket.names():
                if name != LEASE:
                    self._fetch(name)
            self._is_owner = True
            yield
        finally:
            self._is_owner = False
            ended.set()
            keeper.join()
            with contextlib.suppress(OSError):  # it runs out by itself
                self.bucket.remove(LEASE)
            self._clear()

    def _renew(self, token: str, ended: threading.Event) -> None:
        while not ended.wait(_RENEWED):
            with contextlib.suppress(OSError):  # whoever writes a file is told
                self._claim(token)

    def _claim(self, token: str) -> None:
        now = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
        lease = {"token": token, "pid": os.getpid(), "host": socket.gethostname(), "at": now}
        self.bucket.put(LEASE, json.dumps({**lease, "until": time.time() + _LASTS}).encode())

    def _lease(self) -> dict[str, Any] | None:
        """The lease that is there, if it is one."""
        try:
            found = json.loads(self.bucket.read(LEASE) or b"null")
            return {**found, "pid": int(found["pid"]), "until": float(found["until"])}
        except (ValueError, KeyError, TypeError):
            return None

    def _require_free(self) -> None:
        """Raise `SettingError` if another process holds the lease."""
        lease = self._lease()
        if lease is None or lease["until"] < time.time() or _is_gone(lease):
            return
        rule = "a folder that no other process writes"
        owner = f"process {lease['pid']} on {lease.get('host')}, at {lease.get('at')}"
        raise SettingError(f"{self.name} must be {rule}, got {self.shown!r}, owned by {owner}")


def _is_gone(lease: dict[str, Any]) -> bool:
    """Whether a lease is that of a process of this machine that lives no more."""
    if lease.get("host") != socket.gethostname():
        return False
    try:
        os.kill(lease["pid"], 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return False
