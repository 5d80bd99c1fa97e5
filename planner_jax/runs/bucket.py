"""Files of a run in an object store: put whole, read, listed and removed, by Arrow's file system.

What is put is there whole or not at all, since a store shows an object once its upload has ended.
Where the store is, and who asks, says the environment: AWS_ENDPOINT_URL, AWS_REGION and all by
which Amazon's own tools find credentials.
"""

import contextlib
import dataclasses
import errno
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import fs

from planner_jax.runs.settings import SCHEME

_CONNECTING, _ANSWERING = 10, 60  # [s], the longest that a store is waited for
_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")


@dataclasses.dataclass(frozen=True)
class Bucket:
    """The objects below one address; names of files are relative to it, as "parts/NAME"."""

    address: str  # s3://BUCKET/PATH
    files: fs.FileSystem

    @property
    def place(self) -> str:
        """The address as the file system has it."""
        return self.address.removeprefix(SCHEME)

    def put(self, name: str, content: Any) -> None:
        """Write a file whole; its content is bytes or a buffer.

        Raises:
            OSError: the store does not take it; its `filename` is the address.
        """
        with self._told(name), self.files.open_output_stream(f"{self.place}/{name}") as stream:
            stream.write(content)

    def send(self, name: str, path: Path) -> None:
        """Write a file that lies on the disk."""
        with pa.memory_map(str(path)) as file:
            self.put(name, file.read_buffer())

    def read(self, name: str) -> bytes | None:
        """The content of a file, or None where there is none.

        Raises:
            OSError: the store does not answer, or refuses.
        """
        with self._told(name):
            try:
                with self.files.open_input_stream(f"{self.place}/{name}") as stream:
                    return stream.read()
            except FileNotFoundError:
                return None

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        with self._told(name), contextlib.suppress(FileNotFoundError):
            self.files.delete_file(f"{self.place}/{name}")

    def names(self) -> list[str]:
        """All files, by name."""
        everything = fs.FileSelector(self.place, recursive=True, allow_not_found=True)
        with self._told(""):
            found = self.files.get_file_info(everything)
        start = len(self.place) + 1
        return sorted(info.path[start:] for info in found if info.type == fs.FileType.File)

    @contextlib.contextmanager
    def _told(self, name: str) -> Iterator[None]:
        """Give errors of the store the address and one line."""
        try:
            yield
        except (OSError, pa.ArrowException) as error:
            raise _as_told(error, f"{self.address}/{name}".rstrip("/")) from None


def _as_told(error: Exception, address: str) -> OSError:
    """What a store says, as an error of the file at an address, in one line."""
    number = getattr(error, "errno", None) or errno.EIO
    return OSError(number, " ".join(str(error).split()), address)


def bucket_of(address: str, name: str) -> Bucket:
    """The place in an object store that an argument names.

    Args:
        address: s3://BUCKET/PATH.
        name: of the argument, for messages.

    Raises:
        ValueError: it names no bucket, or no path in it; one line.
        OSError: the bucket's region cannot be asked for.
    """
    bucket, _, path = address.removeprefix(SCHEME).strip("/").partition("/")
    words = path.split("/")
    if not _BUCKET.fullmatch(bucket) or not path or not all(words) or {".", ".."} & set(words):
        raise ValueError(f"{name} must be {SCHEME}BUCKET/PATH, got {address!r}")
    region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")
    elsewhere = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    if region is None and not elsewhere:
        try:
            region = fs.resolve_s3_region(bucket)
        except OSError as error:
            raise _as_told(error, address) from None
    files = fs.S3FileSystem(
        region=region,
        endpoint_override=elsewhere,
        connect_timeout=_CONNECTING,
        request_timeout=_ANSWERING,
    )
    return Bucket(f"{SCHEME}{bucket}/{path}", files)
