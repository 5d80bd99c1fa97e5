"""Libraries as files: a header of text, then arrays that are mapped into memory; no pickle.

    planner-jax block library 1
    {"fingerprint": ..., "layout": ..., "links": ..., "arrays": ..., "size": ...}

The second line is JSON: hash of the setting, faces with cells, links of the arm's capsules, name,
kind, shape and place of every array, and the file's size. Blanks fill it up to the first array.
Arrays are little-endian, in C order, and begin at multiples of 64 bytes.
"""

import dataclasses
import json
import os
from typing import Any

import numpy as np

from planner_jax.baselines.block.library.cells import Face, Layout
from planner_jax.baselines.block.library.table import (
    Library,
    Setting,
    fingerprint,
    library_of,
    pieces_of,
)
from planner_jax.core.errors import ArgumentError
from planner_jax.host.files import open_plain, replacing
from planner_jax.robot.arm import Arm, ArmLimits
from planner_jax.task.block.scene import Box, Scene

VERSION = 1
BUILD_VERSION = 1  # of how libraries are planned: parts of another one are not gone on with
_MAGIC = "planner-jax block library"
_ALIGNED, _LONGEST = 64, 1 << 20  # bytes


def save_library(path: str | os.PathLike, library: Library) -> None:
    """Write a library, whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    table, setting = library.table, library.setting
    arrays = {"rows": np.asarray(table.rows, "<f4"), "homes": np.asarray(table.homes, "<f4")}
    arrays |= {name: _plain(leaf) for name, leaf in _leaves(setting) if name != _LINKS}
    header: dict[str, Any] = {
        "fingerprint": fingerprint(setting),
        "layout": dataclasses.asdict(table.layout),
        "links": list(setting.arm.capsule_link),
    }
    places, end = {}, 0
    for name, array in arrays.items():
        places[name] = end
        end = _up(end + array.nbytes)
    kinds = {name: [array.dtype.str, list(array.shape)] for name, array in arrays.items()}

    def text(begin: int) -> bytes:
        header["arrays"] = {name: [*kinds[name], begin + places[name]] for name in arrays}
        header["size"] = begin + end
        return f"{_MAGIC} {VERSION}\n{json.dumps(header)}\n".encode()

    begin = _up(len(text(1 << 40)))
    with replacing(path) as scratch, open(scratch, "wb") as file:
        lines = text(begin)
        file.write(lines[:-1] + b" " * (begin - len(lines)) + b"\n")
        for array in arrays.values():
            file.write(array.tobytes() + bytes(_up(array.nbytes) - array.nbytes))


def load_library(path: str | os.PathLike) -> Library:
    """The library that `save_library` wrote; its table is mapped, read when it is looked at.

    Raises:
        ArgumentError: the file is not there, is something else, of another version, or cut off.
    """
    shown = repr(os.fspath(path))
    try:
        with open_plain(path) as file:
            first = file.readline(_LONGEST)
            second = file.readline(_LONGEST)
            size = os.fstat(file.fileno()).st_size
    except OSError as error:
        hint = f"`planner-jax library build {os.fspath(path)}` makes one"
        shown = f"{shown} ({error.strerror}); {hint}"
        raise ArgumentError("library", "a file", shown=shown) from None
    magic, _, version = first.decode("latin-1").rstrip("\n").rpartition(" ")
    if magic != _MAGIC:
        raise ArgumentError("library", "a file of a block library", shown=shown)
    if version != str(VERSION):
        raise ArgumentError(
            "library", f"of version {VERSION}", shown=f"version {version} in {shown}"
        )
    try:
        header = json.loads(second)
    except (ValueError, RecursionError):
        raise ArgumentError("library", f"a whole file, {shown} is cut off", shown="") from None
    try:
        if size != header["size"]:
            raise ArgumentError(
                "library", f"a whole file of {header['size']} bytes", shown=f"{size} in {shown}"
            )
        library, rows = _library(path, header)
    except (KeyError, TypeError, IndexError, AttributeError, OverflowError, OSError) as error:
        raise _damaged(shown, error) from None
    except ValueError as error:
        raise error if isinstance(error, ArgumentError) else _damaged(shown, error) from None
    layout = library.table.layout
    known, found = header["fingerprint"], fingerprint(library.setting)
    if known != found or rows.shape[1] != layout.num_pairs or pieces_of(rows) < 1:
        raise ArgumentError(
            "library", f"the setting {known}", verb="have", shown=f"{found} in {shown}"
        )
    return library


def _damaged(shown: str, error: Exception) -> ArgumentError:
    return ArgumentError(
        "library", f"a whole file, {shown} has a damaged header ({type(error).__name__})", shown=""
    )


def _library(path: str | os.PathLike, header: dict[str, Any]) -> tuple[Library, np.ndarray]:
    """The library that a header describes, and its rows, which are mapped."""
    arrays: dict[str, Any] = {
        name: np.memmap(path, kind, "r", place, tuple(shape))
        if shape
        else np.memmap(path, kind, "r", place, (1,))[0]
        for name, (kind, shape, place) in header["arrays"].items()
    }
    layout = Layout(*(tuple(_face(face) for face in header["layout"][s]) for s in _BOXES))
    rows = arrays.pop("rows")
    homes = np.array(arrays.pop("homes"))
    return library_of(rows, homes, layout, _setting(header, arrays)), rows


_BOXES = ("outer", "inner")
_LINKS = "arm.capsule_link"


def _face(values: dict[str, Any]) -> Face:
    return Face(values["axis"], values["side"], tuple(values["cells"]))


def _setting(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Setting:
    """The setting of arrays by the names of its leaves."""
    leaves = {name: np.array(value) for name, value in arrays.items()}

    def tree(kind: Any, prefix: str, **other: Any) -> Any:
        names = {field.name for field in dataclasses.fields(kind)} - other.keys()
        return kind(**{name: leaves[prefix + name] for name in names}, **other)

    return Setting(
        arm=tree(Arm, "arm.", capsule_link=tuple(header["links"])),
        limits=tree(ArmLimits, "limits."),
        ends_at_rest=leaves["ends_at_rest"],  # type: ignore[arg-type]
        scene=tree(
            Scene, "scene.", **{name: tree(Box, f"scene.{name}.") for name in ("inner", "outer")}
        ),
    )


def _leaves(tree: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """Names, joined by dots, and leaves of a dataclass."""
    found = []
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        name = prefix + field.name
        inner = dataclasses.is_dataclass(value)
        found += _leaves(value, f"{name}.") if inner else [(name, value)]
    return found


def _plain(leaf: Any) -> np.ndarray:
    """An array as it is written."""
    value = np.ascontiguousarray(leaf)
    return value.astype({"f": "<f4", "b": "|b1"}.get(value.dtype.kind, "<i4")).reshape(
        np.shape(leaf)
    )


def _up(size: int) -> int:
    return -(-size // _ALIGNED) * _ALIGNED
