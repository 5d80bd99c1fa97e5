"""Functions that read regular files only, and write files atomically."""

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


def open_plain(path: str | os.PathLike) -> BinaryIO:
    """Open a regular file to read bytes; raise `OSError` for a folder, a pipe or a device."""
    # Without O_NONBLOCK, opening a pipe waits for a writer.
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "it is no plain file", os.fspath(path))
    return os.fdopen(handle, "rb")


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Provide a scratch file, which replaces the file `path` if the block ends without an error.

    The scratch file is flushed to the disk before it is renamed, and the folder afterwards. Its
    name ends with the name of the file, because some writers derive the format from the suffix.

    Raises:
        OSError: the file cannot be written; its `filename` is `path`.
    """
    place = Path(path)
    scratch = place.with_name(f".{os.getpid()}.tmp.{place.name}")
    try:
        yield scratch
        to_disk(scratch)
        os.replace(scratch, place)
        to_disk(place.parent)
    except OSError as error:
        if error.filename not in (None, scratch, os.fspath(scratch)):
            raise  # the error is of another file that the block reads or writes
        raise OSError(error.errno, error.strerror or str(error), os.fspath(place)) from error
    finally:
        with contextlib.suppress(OSError):
            scratch.unlink()


def new_file_problem(path: str | os.PathLike) -> str:
    """Return "" if a file can be created at a path, else what it must be, such as "a new file"."""
    place = Path(path)
    if os.path.lexists(place):
        return "a new file"
    if not place.parent.is_dir() or not os.access(place.parent, os.W_OK | os.X_OK):
        return "in a folder that can be written"
    return ""


def to_disk(path: Path) -> None:
    """Flush the content of a file, or the list of files of a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def is_scratch(path: Path) -> bool:
    """Return whether a file is named like the scratch files that `replacing` creates."""
    first, _, rest = path.name.removeprefix(".").partition(".")
    return path.name.startswith(".") and first.isdigit() and rest.startswith("tmp.")
