"""Files that are read: plain ones, none that a reader would wait for in vain."""

import errno
import os
import stat
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
