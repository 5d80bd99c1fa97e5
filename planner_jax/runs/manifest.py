"""The manifest of a run: its format, what it must hold, and whether it is as it was written.

A manifest is a JSON object with `format`, a number, and `digest`, by which every change of it is
known. What other files of the run were when they were written stands under `files`.
"""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from planner_jax.runs.plain_json import JsonError, read_object, require_sealed, sealed
from planner_jax.runs.settings import SettingError

FORMAT = 1  # of manifest, parts, rows and recordings
STATES = ("running", "interrupted", "complete", "failed")


class Rule(NamedTuple):
    """What an entry has to be."""

    words: str
    holds: Callable[[Any], bool]


def is_number(value: Any) -> bool:
    """Whether a value is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def is_count(value: Any) -> bool:
    """Whether a value is an integer >= 0."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _counts(value: Any) -> bool:
    return isinstance(value, dict) and all(map(is_count, value.values()))


def _files(value: Any) -> bool:
    entries = {"bytes": is_count, "crc32": is_count}
    return isinstance(value, dict) and all(
        isinstance(each, dict)
        and each.keys() == entries.keys()
        and all(entries[name](found) for name, found in each.items())
        for each in value.values()
    )


def _interval(value: Any) -> bool:
    is_pair = isinstance(value, list) and len(value) == 2 and all(map(is_number, value))
    return is_pair and 0.0 <= value[0] <= value[1] <= 1.0


_TEXT = Rule("text", lambda x: isinstance(x, str))
_OBJECT = Rule("an object", lambda x: isinstance(x, dict))
_COUNT = Rule("an integer >= 0", is_count)
_POSITIVE = Rule("an integer >= 1", lambda x: is_count(x) and x >= 1)
_SECONDS = Rule("finite and >= 0", lambda x: is_number(x) and x >= 0.0)

_EVERY = {
    "kind": _TEXT,
    "state": Rule(f"one of {', '.join(STATES)}", lambda x: x in STATES),
    "parameters": _OBJECT,
}
_FINISHED = {"summary": _OBJECT, "times": _OBJECT, "files": Rule("sizes and sums", _files)}
_RATES = {
    "num": _POSITIVE,
    "successes": _COUNT,
    "success_rate": Rule("within 0 and 1", lambda x: is_number(x) and 0.0 <= x <= 1.0),
    "wilson_95": Rule("two numbers within 0 and 1", _interval),
}
# By the first word of the kind: entries of the manifest, of its summary and of its times.
_OF_RUN = {
    "sweep": {
        "run": _TEXT,
        "settings": _TEXT,
        "versions": _OBJECT,
        "device": _OBJECT,
        "sessions": Rule("a list", lambda x: isinstance(x, list)),
    },
    "fly": {"seed": _COUNT, "device": _OBJECT, "loop": _OBJECT},
}
_OF_SUMMARY = {
    "sweep": {
        **_RATES,
        "plans_per_second_warm": _SECONDS,
        "status_counts": Rule("counts", _counts),
        "failed_limits": Rule("counts", _counts),
    },
    "fly": {**_RATES, "tracking_rms_median": _SECONDS, "tracking_worst": _SECONDS},
}
_OF_TIMES = {
    "sweep": ("compile_seconds", "referee_seconds", "wall_seconds"),
    "fly": ("compile_seconds", "wall_seconds"),
}


def to_write(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Entries with format and digest."""
    return sealed({"format": FORMAT, **entries})


def read_manifest(path: Path, name: str, folder: str) -> dict[str, Any]:
    """The manifest of a run.

    Args:
        path: of the file `manifest.json`.
        name: of the caller's argument that holds the folder, for messages.
        folder: as the caller has it, likewise.

    Raises:
        SettingError: there is none, it is of another format, or it is not as it was written.
    """
    manifest = read_sealed(path, name, "a run", folder)
    _require_sound(manifest, name, f"{path.name} of {folder!r}")
    return manifest


def read_sealed(path: Path, name: str, what: str, folder: str | None = None) -> dict[str, Any]:
    """The entries of a file of a folder, as `to_write` has them.

    Args:
        path: of the file.
        name: of the caller's argument that holds the folder, for messages.
        what: the folder is of, in words.
        folder: as the caller has it, where that is not the path of the file's own.

    Raises:
        SettingError: there is none, it is of another format, or it is not as it was written.
    """
    shown = repr(str(path.parent) if folder is None else folder)
    try:
        entries = read_object(path)
    except (OSError, JsonError) as error:
        why = f" ({path.name} {error})" if isinstance(error, JsonError) else ""
        rule = f"the folder of {what}, with its {path.name}"
        raise SettingError(f"{name} must be {rule}, got {shown}{why}") from None
    require_format(entries, name, what, shown)
    try:
        require_sealed(entries)
    except JsonError as error:
        rule = f"{what} whose {path.name} is whole"
        raise SettingError(f"{name} must be {rule}, got {shown}, where it {error}") from None
    return entries


def require_format(entries: Mapping[str, Any], name: str, what: str, shown: str) -> None:
    """Raise `SettingError` unless entries are of the format that is understood.

    Args:
        entries: with `format`.
        name: of the caller's argument that holds the folder.
        what: has a format, in words.
        shown: the folder.
    """
    found = entries.get("format")
    if found != FORMAT or isinstance(found, bool | float):
        told = "one without a format" if found is None else f"format {str(found)[:40]}"
        raise SettingError(f"{name} must be {what} of format {FORMAT}, got {told} in {shown}")


def _require_sound(manifest: dict[str, Any], name: str, place: str) -> None:
    """Raise `SettingError` unless the entries that are read are there and can be."""

    def check(entries: Any, rules: Mapping[str, Rule], prefix: str = "") -> None:
        for key, rule in rules.items():
            if key not in entries or not rule.holds(entries[key]):
                told = f"{str(entries[key])[:40]!r}" if key in entries else "nothing"
                what = f"a run with {prefix}{key} that is {rule.words}"
                raise SettingError(f"{name} must be {what}, got {told} in {place}")

    check(manifest, _EVERY)
    kind = manifest["kind"].partition(" ")[0]
    check(manifest, _OF_RUN.get(kind, {}))
    if kind in _OF_SUMMARY and ("summary" in manifest or manifest["state"] == "complete"):
        check(manifest, _FINISHED)
        summary = manifest["summary"]
        check(summary, _OF_SUMMARY[kind], "summary.")
        check(manifest["times"], dict.fromkeys(_OF_TIMES[kind], _SECONDS), "times.")
        within = Rule(f"<= {summary['num']}", lambda x: x <= summary["num"])
        check(summary, {"successes": within}, "summary.")
