"""Save and load dataclasses of arrays as .npz files of NumPy, with a version and no pickle."""

import contextlib
import dataclasses
import errno
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

from planner_jax.core.checks import require_path_name, require_values
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.rules import nodes_of
from planner_jax.host.files import open_plain, replacing

VERSION = 1
LARGEST = 1 << 28  # [B] greatest size of a file of plans, and of all its arrays together
_DIRECTORY, _LONGEST = 1 << 20, 1 << 16  # [B] greatest directory of an archive; [characters] header
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
    require_values("save", tree)
    header = json.dumps({"version": VERSION, "class": type(tree).__name__})
    arrays = {name: np.asarray(leaf) for name, leaf in leaves_by_name(tree).items()}
    for name, array in arrays.items():
        if array.dtype.kind in "OSU":  # NumPy would pickle objects
            raise ArgumentTypeError(name, "an array of numbers", shown=str(array.dtype))
    most = LARGEST - _DIRECTORY
    if (size := sum(array.nbytes for array in arrays.values())) > most:
        rule = f"of at most {most} bytes; save parts of the batch, as pj.take(plans, k) gives them"
        raise ArgumentError("plans", rule, shown=f"{size} bytes")
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
        text, arrays = read_archive(path, _HEADER, LARGEST)
        header = json.loads(text)
        version, name = header["version"], header["class"]
    except UNREADABLE as error:
        if isinstance(error, FileNotFoundError):
            raise PlanFileError("path", "a file of plans", str(path)) from None
        raise PlanFileError(
            "path", "a whole file of plans", shown=f"{str(path)!r} ({name_damage(error)})"
        ) from None
    return version, name, arrays


def read_archive(
    path: str | os.PathLike, header: str, most: int
) -> tuple[str, dict[str, np.ndarray]]:
    """Return the text of the array `header` of a NumPy archive, and its other arrays by name.

    The file has at most `most` bytes, and so have all its arrays together. Nothing is unpickled. A
    damaged archive raises one of `UNREADABLE`.
    """
    with open_plain(path, most) as file:
        # An archive ends with the 22 bytes of its end record, which state the directory's size. A
        # second record in front of them could name a directory of millions of members instead.
        file.seek(-min(42, os.fstat(file.fileno()).st_size), os.SEEK_END)
        end = file.read()
        is_usual = end[-22:-18] == b"PK\5\6" and not end.startswith(b"PK\6\7")
        if not is_usual or int.from_bytes(end[-10:-6], "little") > _DIRECTORY:
            raise zipfile.BadZipFile("it is no archive of NumPy")
        with zipfile.ZipFile(file) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > most:
            raise OSError(errno.EFBIG, f"its arrays are larger than {most} bytes", os.fspath(path))
        file.seek(0)
        # NumPy would not close a broken file that it has opened itself.
        with np.load(file, allow_pickle=False) as found:
            arrays = dict(found)
    text = arrays.pop(header)
    if text.shape or text.dtype.kind != "U" or text.dtype.itemsize > 4 * _LONGEST:
        raise ValueError(f"{header} is no text")
    return str(text), arrays


def name_damage(error: Exception) -> str:
    """Return why a file cannot be read: the reason of an `OSError`, or the class of the error."""
    return getattr(error, "strerror", None) or type(error).__name__


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
