"""Save and load dataclasses of arrays as .npz files of NumPy, with a version and no pickle."""

import contextlib
import dataclasses
import json
import os
import struct
import typing
import zipfile
import zlib
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import PyTree

from planner_jax.core.checks import require_path_name
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.rules import nodes_of
from planner_jax.host.files import open_plain, replacing

VERSION = 1
# Exceptions that NumPy and the archive's reader raise on a damaged file.
UNREADABLE = (
    *(OSError, ValueError, KeyError, TypeError, EOFError, RuntimeError, MemoryError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)
_HEADER = "header"
Kind = TypeVar("Kind")


class PlanFileError(ArgumentError):
    """A file cannot be read as plans; the text is one line that names the file."""


def save_arrays(path: str | os.PathLike, tree: PyTree) -> None:
    """Write a (nested) dataclass of arrays to a .npz file, which is unchanged if writing fails."""
    require_path_name("path", path)
    header = json.dumps({"version": VERSION, "class": type(tree).__name__})
    arrays = {name: np.asarray(leaf) for name, leaf in leaves_by_name(tree).items()}
    for name, array in arrays.items():
        if array.dtype.kind in "OSU":  # NumPy would pickle objects
            raise ArgumentTypeError(name, "an array of numbers", shown=str(array.dtype))
    with replacing(path) as scratch, open(scratch, "wb") as file:
        np.savez(file, **{_HEADER: np.array(header), **arrays})  # type: ignore[arg-type]


def load_arrays(path: str | os.PathLike, kind: type[Kind]) -> Kind:
    """Return the dataclass that `save_arrays` wrote, in NumPy arrays, or raise `PlanFileError`."""
    require_path_name("path", path)
    version, name, arrays = _read(path)
    if version != VERSION or name != kind.__name__:
        raise _other_file(path, kind.__name__, version, name)
    try:
        tree = build_tree(kind, "", arrays)
    except KeyError as error:
        raise PlanFileError("path", error.args[0], str(path), verb="hold") from None
    if arrays:
        raise PlanFileError("path", ", ".join(arrays), str(path), verb="not hold")
    return tree


def load_fitting(path: str | os.PathLike, kinds: Sequence[type[Kind]]) -> Kind:
    """Load a file of `save_arrays` as the first of several classes whose fields it contains."""
    version, name, arrays = _read(path)
    if version == VERSION:
        for kind in kinds:
            with contextlib.suppress(KeyError):
                return build_tree(kind, "", dict(arrays))
    raise _other_file(path, " or ".join(kind.__name__ for kind in kinds), version, name)


def _other_file(
    path: str | os.PathLike, names: str, version: object, name: object
) -> PlanFileError:
    shown = f"{name} of version {version} in {str(path)!r}"
    return PlanFileError("path", f"a file of {names} of version {VERSION}", shown=shown)


def _read(path: str | os.PathLike) -> tuple[object, object, dict[str, np.ndarray]]:
    try:
        # NumPy would not close a broken file that it has opened itself.
        with open_plain(path) as raw, np.load(raw, allow_pickle=False) as file:
            arrays = dict(file)
        header = json.loads(str(arrays.pop(_HEADER)))
        version, name = header["version"], header["class"]
    except UNREADABLE as error:
        if isinstance(error, FileNotFoundError):
            raise PlanFileError("path", "a file of plans", str(path)) from None
        raise PlanFileError(
            "path", "a whole file of plans", shown=f"{str(path)!r} ({type(error).__name__})"
        ) from None
    return version, name, arrays


def leaves_by_name(tree: PyTree, prefix: str = "") -> dict[str, PyTree]:
    """Return the arrays of a nested dataclass by `prefix` + dotted name, such as "limits.speed"."""
    leaves = {}
    defaults = {field.name: field.default for field in dataclasses.fields(tree)}
    for name, value in nodes_of(tree).items():
        place = prefix + name
        if value is None and defaults[name] is None:
            continue
        inner = dataclasses.is_dataclass(value)
        leaves |= leaves_by_name(value, f"{place}.") if inner else {place: value}
    return leaves


def build_tree(kind: type[Kind], prefix: str, arrays: dict[str, PyTree]) -> Kind:
    """Build a dataclass from the `arrays` named `prefix` + field name, and remove these from it."""
    types = typing.get_type_hints(kind)
    values = {}
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        inner, place = types[field.name], prefix + field.name
        if type(None) in typing.get_args(inner):
            inner = next(each for each in typing.get_args(inner) if each is not type(None))
            if not any(f"{name}.".startswith(f"{place}.") for name in arrays):
                values[field.name] = None
                continue
        if isinstance(inner, type) and dataclasses.is_dataclass(inner):
            values[field.name] = build_tree(inner, f"{place}.", arrays)
        else:
            values[field.name] = arrays.pop(place)
    return kind(**values)
