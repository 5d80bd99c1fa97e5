"""The standard streams of a command: no text and no full disk ends a command with an error."""

import contextlib
import io
import sys
from typing import TextIO, cast


class _Lenient:
    """A text stream that drops what cannot be written, such as progress on a full disk."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)

    def write(self, text: str, /) -> int:
        with contextlib.suppress(OSError):
            return self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.flush()


def prepare_streams() -> None:
    """Let the output escape characters that its encoding lacks, and never raise for progress."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # None if it is closed
        sys.stdout.reconfigure(errors="backslashreplace")
    if sys.stderr is not None:
        sys.stderr = cast(TextIO, _Lenient(sys.stderr))
