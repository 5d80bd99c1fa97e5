"""JSON files of runs, such as `manifest.json`, with their format version and a SHA-256 digest."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

from planner_jax.core.errors import ArgumentError, PlannerJaxError
from planner_jax.host.files import read_plain

FORMAT = 2  # version number of the format of all files in a run's folder
MANIFEST = "manifest.json"
LARGEST = 1 << 22  # [B] greatest size of a file that is read

Entries: TypeAlias = dict[str, Any]  # entries of a JSON object, such as a manifest
Row: TypeAlias = Mapping[str, Any]  # values of a row by column


class JsonError(PlannerJaxError, ValueError):
    """Error: a text is not JSON of the expected format, or was changed; the message says why."""


def digest_of(entries: Mapping[str, object]) -> str:
    """Return the SHA-256 of all entries except `digest`, independent of their order."""
    kept = {name: value for name, value in entries.items() if name != "digest"}
    text = json.dumps(kept, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def to_write(entries: Mapping[str, object]) -> Entries:
    """Return `entries` with the version number of the format and a digest, to write as JSON."""
    kept = {"format": FORMAT, **{k: v for k, v in entries.items() if k not in ("format", "digest")}}
    return {**kept, "digest": digest_of(kept)}


def parse_object(text: bytes | str) -> Entries:
    """Parse a text as one JSON object; raise `JsonError` if it is anything else."""
    try:
        found = json.loads(text)
    except RecursionError:
        raise JsonError("is nested too deeply") from None
    except ValueError:
        raise JsonError("is not JSON") from None
    if not isinstance(found, dict):
        raise JsonError("is not an object")
    return found


def parse_written(text: bytes | str) -> Entries:
    """Parse JSON text made from `to_write`; raise `JsonError` if format or digest do not match."""
    entries = parse_object(text)
    if type(found := entries.get("format")) is not int or found != FORMAT:
        shown = "no format" if found is None else f"format {str(found)[:40]}"
        raise JsonError(f"has {shown}, and this version reads format {FORMAT} alone")
    try:
        is_whole = entries.get("digest") == digest_of(entries)
    except (RecursionError, ValueError):
        is_whole = False
    if not is_whole:
        raise JsonError("was edited or damaged: its digest does not fit its entries")
    return entries


def read_written(path: Path, name: str, what: str) -> Entries:
    """Read a JSON file whose object `to_write` made, and return its entries.

    Error messages name the argument `name` and the contents `what`, such as "a run".

    Raises:
        ArgumentError: the file is missing, has another format, or was edited or damaged.
    """
    shown = repr(str(path.parent))
    try:
        return parse_written(read_plain(path, LARGEST))
    except OSError as error:
        rule = f"the folder of {what}, with its {path.name}"
        why = "" if isinstance(error, FileNotFoundError) else f" ({error.strerror})"
        raise ArgumentError(name, rule, shown=f"{shown}{why}") from None
    except JsonError as error:
        rule = f"{what} whose {path.name} is whole"
        raise ArgumentError(name, rule, shown=f"{shown}, where it {error}") from None
