"""The standard streams of a command: no text and no full disk ends a command with an error."""

import contextlib
import io
import sys


class _Lenient(io.TextIOWrapper):
    """A text stream that drops what cannot be written, such as progress on a full disk."""

    def write(self, text: str, /) -> int:
        with contextlib.suppress(OSError):
            return super().write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            super().flush()


def prepare_streams() -> None:
    """Let the output escape characters that its encoding lacks, and never raise for progress."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # None if it is closed
        sys.stdout.reconfigure(errors="backslashreplace")
    if isinstance(sys.stderr, io.TextIOWrapper):
        old = sys.stderr
        sys.stderr = _Lenient(old.buffer, old.encoding, old.errors, line_buffering=True)
