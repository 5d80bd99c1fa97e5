"""Read regular files only, and write files atomically."""

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


def open_plain(path: str | os.PathLike) -> BinaryIO:
    """A file, open to read bytes.

    Raises:
        OSError: it cannot be opened, or it is a folder, a pipe or a device.
    """
    # Opening a pipe waits for a writer, if it is not told not to.
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "it is no plain file", os.fspath(path))
    return os.fdopen(handle, "rb")


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """A scratch file that takes the place of a file once the block has ended well.

    It is on the disk before it does so, and its new name before the block is left. Its own name
    holds the number of the process and ends in that of the file, by which some tell its format.

    Args:
        path: of the file.

    Raises:
        OSError: the file cannot be written; its `filename` is the path.
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
            raise  # of another file that the block reads or writes
        raise OSError(error.errno, error.strerror or str(error), os.fspath(place)) from error
    finally:
        with contextlib.suppress(OSError):
            scratch.unlink()


def new_file_problem(path: str | os.PathLike) -> str:
    """What a path must be, in words, if no new file can be made there; "" if one can."""
    place = Path(path)
    if os.path.lexists(place):
        return "a new file"
    if not place.parent.is_dir() or not os.access(place.parent, os.W_OK | os.X_OK):
        return "in a folder that can be written"
    return ""


def to_disk(path: Path) -> None:
    """Wait until a file, or the names in a folder, would outlast a loss of power."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def is_scratch(path: Path) -> bool:
    """Whether a file is what `replacing` leaves where its process is killed."""
    first, _, rest = path.name.removeprefix(".").partition(".")
    return path.name.startswith(".") and first.isdigit() and rest.startswith("tmp.")
