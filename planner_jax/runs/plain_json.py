"""JSON that was written by this project: read whole or refused in one line, with a digest."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from planner_jax.host.files import open_plain

DIGEST = "digest"  # the entry that says what the others were when they were written
_LARGEST = 1 << 26  # bytes


class JsonError(ValueError):
    """A text is not what was written; a few words that say why."""


def read_object(path: Path) -> dict[str, Any]:
    """The object in a file.

    Raises:
        JsonError: there is none; not JSON, or too large.
        OSError: there is no such file, it is no plain one, or it cannot be read.
    """
    with open_plain(path) as file:
        text = file.read(_LARGEST + 1)
    if len(text) > _LARGEST:
        raise JsonError(f"is larger than {_LARGEST} bytes")
    return parse_object(text)


def parse_object(text: bytes | str) -> dict[str, Any]:
    """The object of a text.

    Raises:
        JsonError: there is none.
    """
    try:
        found = json.loads(text)
    except RecursionError:
        raise JsonError("is nested too deeply") from None
    except ValueError:
        raise JsonError("is not JSON") from None
    if not isinstance(found, dict):
        raise JsonError("is not an object")
    return found


def digest_of(entries: Mapping[str, Any]) -> str:
    """SHA-256 of the entries but `digest`, whatever their order."""
    kept = {name: value for name, value in entries.items() if name != DIGEST}
    text = json.dumps(kept, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def sealed(entries: Mapping[str, Any]) -> dict[str, Any]:
    """The entries with their digest behind them."""
    kept = {name: value for name, value in entries.items() if name != DIGEST}
    return {**kept, DIGEST: digest_of(kept)}


def require_sealed(entries: Mapping[str, Any]) -> None:
    """Raise `JsonError` unless entries are those that were `sealed`."""
    try:
        whole = entries.get(DIGEST) == digest_of(entries)
    except (RecursionError, ValueError):
        whole = False
    if not whole:
        raise JsonError("was edited or damaged: its digest is not that of its entries")
