"""Who writes a run folder: one process at a time, by a lock that ends with the process."""

import contextlib
import datetime
import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from planner_jax.runs.settings import SettingError

LOCK = ".lock"
_TRIES, _BETWEEN = 20, 0.01  # looks at a lock that is taken, and seconds from one to the next


@contextlib.contextmanager
def owned(folder: Path, name: str) -> Iterator[None]:
    """Own a folder for the length of the block.

    The lock is of the file `.lock`, which says who holds it and is removed in the end. The system
    frees the lock of a process that is killed.

    Args:
        folder: that exists.
        name: of the caller's argument that holds the folder, for messages.

    Raises:
        SettingError: another process owns the folder, or no lock can be had there.
    """
    handle = _locked(folder, name)
    try:
        os.ftruncate(handle, 0)
        os.pwrite(handle, json.dumps(_self()).encode(), 0)
        yield
    finally:
        if _is_at(handle, folder / LOCK):
            (folder / LOCK).unlink(missing_ok=True)
        os.close(handle)


def require_free(folder: Path, name: str) -> None:
    """Raise `SettingError` if a process owns a folder; writes nothing."""
    try:
        handle = os.open(folder / LOCK, os.O_RDONLY | os.O_NONBLOCK)  # it may be a pipe
    except OSError:
        return
    try:
        if not _lock(handle, fcntl.LOCK_SH):
            raise SettingError(_taken(folder, name, handle))
    finally:
        os.close(handle)


def _locked(folder: Path, name: str) -> int:
    """A handle of the lock's file, which is locked."""
    path = folder / LOCK
    try:
        while True:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                if not _lock(handle, fcntl.LOCK_EX):
                    raise SettingError(_taken(folder, name, handle))
                if _is_at(handle, path):  # not of an owner who has removed it meanwhile
                    return handle
            except BaseException:
                os.close(handle)
                raise
            os.close(handle)
    except OSError as error:
        rule = "a folder that can be written and locked"
        shown = f"{str(folder)!r} ({error.strerror})"
        raise SettingError(f"{name} must be {rule}, got {shown}") from None


def _lock(handle: int, kind: int) -> bool:
    """Whether a lock was had. One who only looks whether there is an owner is waited for."""
    for _ in range(_TRIES):
        try:
            fcntl.flock(handle, kind | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            time.sleep(_BETWEEN)
    return False


def _is_at(handle: int, path: Path) -> bool:
    """Whether an open file is the one of this path."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except OSError:
        return False


def _self() -> dict[str, str | int]:
    since = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
    return {"pid": os.getpid(), "host": socket.gethostname(), "since": since}


def _taken(folder: Path, name: str, handle: int) -> str:
    """Says who owns a folder."""
    try:
        found = json.loads(os.pread(handle, 4096, 0))
        owner = f"process {found['pid']} on {found['host']}, since {found['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        owner = "another process"
    rule = "a folder that no other process writes"
    return f"{name} must be {rule}, got {str(folder)!r}, owned by {owner}"
