"""Which run a part is of, what made it and of which settings: a run is never a mixture."""

import datetime
import os
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from planner_jax.runs.environment import environment
from planner_jax.runs.parquet import file_sum
from planner_jax.runs.plain_json import digest_of
from planner_jax.runs.settings import SettingError
from planner_jax.runs.source import Source

IDENTITY = ("run", "version", "code", "settings")  # of a manifest, and of every part
# What a row depends on besides the code: packages, and what is known of the devices.
_PACKAGES = ("planner-jax", "jax", "jaxlib", "numpy", "scipy")
_OF_DEVICES = {
    "platform": "devices of platform",
    "kind": "devices of kind",
    "count": "devices of count",
    "processor": "processor",
    "threads": "threads of a computation (NPROC)",
}


def begun_now() -> dict[str, Any]:
    """When a session begins, and where."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"started": now, **environment()}


def identity_of(
    source: Source, description: dict[str, Any], session: dict[str, Any]
) -> dict[str, str]:
    """What a new run is known by.

    Args:
        source: of its cases.
        description: of the source.
        session: the first one, as of `begun_now`.
    """
    return {
        "run": uuid.uuid4().hex,
        "version": str(session["versions"]["planner-jax"]),
        "code": session["code"],
        "settings": settings_digest(source, description),
    }


def settings_digest(source: Source, description: dict[str, Any]) -> str:
    """Of all that decides the cases and what is asked of their plans, named files with it."""
    parameters, files = source.settings.parameters(), {}
    for name, value in parameters.items():
        place = value.partition(":")[2] if isinstance(value, str) else ""
        if os.path.isfile(place):  # as in library:FILE
            files[name] = file_sum(Path(place))
    return digest_of({"parameters": parameters, "source": description, "files": files})


def require_same_maker(manifest: dict[str, Any], session: dict[str, Any]) -> None:
    """Raise `SettingError` unless the rest of a run would be planned as it began.

    Args:
        manifest: of the run.
        session: that would go on with it, as of `begun_now`.
    """
    for what, old, new in differences(manifest, session):
        rule = f"resumed by {what} {old}, as it began"
        raise SettingError(f"out must be {rule}, got {new}; or begin anew in another folder")


def differences(
    known: Mapping[str, Any], found: Mapping[str, Any]
) -> Iterator[tuple[str, Any, Any]]:
    """What decides rows and is not the same in two environments: words, and its two values.

    Args:
        known: entries as of `environment`.
        found: likewise.
    """
    looks = [("versions", name, name) for name in _PACKAGES]
    looks += [("device", name, what) for name, what in _OF_DEVICES.items()]
    for entry, name, what in looks:
        old, new = known[entry].get(name), found[entry][name]
        if old != new:
            yield what, old, new
    if known["code"] != found["code"]:
        old, new = (
            f"{each.get('git_commit') or 'unknown'} (files {str(each['code'])[:12]})"
            for each in (known, found)
        )
        yield "planner-jax of commit", old, new
