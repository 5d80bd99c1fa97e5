"""Functions that read regular files of bounded size, name run folders, and write files atomically.

All readers of users' files open them here, so that no pipe blocks and no file fills the memory.
"""

import contextlib
import datetime
import errno
import os
import stat
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

LARGEST = 1 << 26  # [B] greatest size of a file whose reader states no bound of its own


def open_plain(path: str | os.PathLike, most: int = LARGEST) -> BinaryIO:
    """Open a regular file of at most `most` bytes to read bytes; links are followed.

    Raises:
        OSError: the file cannot be read, is larger, or is a folder, a pipe, a socket or a device.
    """
    # Without O_NONBLOCK, opening a pipe waits for a writer.
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    found = os.fstat(handle)
    if not stat.S_ISREG(found.st_mode) or found.st_size > most:
        os.close(handle)
        is_large = stat.S_ISREG(found.st_mode)
        problem = f"it is larger than {most} bytes" if is_large else "it is no plain file"
        raise OSError(errno.EFBIG if is_large else errno.EINVAL, problem, os.fspath(path))
    return os.fdopen(handle, "rb")


def read_plain(path: str | os.PathLike, most: int = LARGEST) -> bytes:
    """Return the content of a regular file of at most `most` bytes; see `open_plain` for errors."""
    with open_plain(path, most) as file:
        content = file.read(most + 1)  # the file may grow after it is opened
    if len(content) > most:
        raise OSError(errno.EFBIG, f"it is larger than {most} bytes", os.fspath(path))
    return content


def crc32_of(file: BinaryIO) -> int:
    """Return the CRC-32 checksum of the remainder of an open file, which is read in blocks."""
    found = 0
    while block := file.read(1 << 20):
        found = zlib.crc32(block, found)
    return found


def name_run_folder(name: str) -> str:
    """Return runs/NAME-DATE-TIME; microseconds tell runs apart that begin within one second."""
    return os.path.join("runs", f"{name}-{datetime.datetime.now():%Y%m%d-%H%M%S-%f}")


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
