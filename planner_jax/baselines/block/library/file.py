"""Library files: a text header, then arrays that are memory-mapped; no pickle.

    planner-jax block library 2
    {"fingerprint": ..., "layout": ..., "links": ..., "arrays": ..., "size": ...}

The second line is JSON. It holds a hash of arm and scene, the cells of both boxes around the arm,
the links to which the arm's collision capsules belong, the file's size, and type, shape and offset
of every array by name. Blanks pad the second line to the first array. Arrays are little-endian, in
C order, and start at multiples of 64 bytes.
"""

import dataclasses
import json
import os

import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from planner_jax.baselines.block.library.cells import Face, Layout
from planner_jax.baselines.block.library.table import (
    Library,
    Setting,
    fingerprint,
    library_of,
    pieces_of,
)
from planner_jax.core.errors import ArgumentError
from planner_jax.core.plan_files import UNREADABLE, build_tree, leaves_by_name
from planner_jax.host.files import open_plain, replacing
from planner_jax.robot.arm import Arm

VERSION = 2
# Version of the planning method. An interrupted build continues only with the same version.
BUILD_VERSION = 1
_MAGIC = "planner-jax block library"
_ALIGNED, _LONGEST = 64, 1 << 20  # [bytes], alignment of arrays; longest line of the header


def save_library(path: str | os.PathLike, library: Library) -> None:
    """Write a library of stored motions to a file atomically, in the format of this module.

    Raises:
        OSError: the file cannot be written.
    """
    table, setting = library.table, library.setting
    arrays = {"rows": np.asarray(table.rows, "<f4"), "homes": np.asarray(table.homes, "<f4")}
    arrays |= {name: _to_stored(leaf) for name, leaf in leaves_by_name(setting).items()}
    header: dict[str, object] = {
        "fingerprint": fingerprint(setting),
        "layout": dataclasses.asdict(table.layout),
        "arm": {name: getattr(setting.arm, name) for name in _named_parts()},
    }
    offsets, end = {}, 0
    for name, array in arrays.items():
        offsets[name] = end
        end = _align(end + array.nbytes)
    kinds = {name: [array.dtype.str, list(array.shape)] for name, array in arrays.items()}

    def text(begin: int) -> bytes:
        header["arrays"] = {name: [*kinds[name], begin + offsets[name]] for name in arrays}
        header["size"] = begin + end
        return f"{_MAGIC} {VERSION}\n{json.dumps(header)}\n".encode()

    begin = _align(len(text(1 << 40)))
    with replacing(path) as scratch, open(scratch, "wb") as file:
        lines = text(begin)
        file.write(lines[:-1] + b" " * (begin - len(lines)) + b"\n")
        for array in arrays.values():
            file.write(array.tobytes() + bytes(_align(array.nbytes) - array.nbytes))


def load_library(path: str | os.PathLike) -> Library:
    """Load a library that `save_library` wrote; its motions are memory-mapped, and read when used.

    Raises:
        ArgumentError: the file is missing, truncated, of another version, or not a library.
    """
    shown = repr(os.fspath(path))
    try:
        with open_plain(path) as file:
            first, second = file.readline(_LONGEST), file.readline(_LONGEST)
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
        whole = header["size"]
        library = _map_library(path, header) if size == whole else None
    except (*UNREADABLE, IndexError, AttributeError, OverflowError) as error:
        damage = f"a whole file, {shown} has a damaged header ({type(error).__name__})"
        raise ArgumentError("library", damage, shown="") from None
    if library is None:
        raise ArgumentError("library", f"a whole file of {whole} bytes", shown=f"{size} in {shown}")
    rows, known = library.table.rows, header["fingerprint"]
    found, num_pairs = fingerprint(library.setting), library.table.layout.num_pairs
    if known != found or rows.shape[1] != num_pairs or pieces_of(rows) < 1:
        rule = f"the setting {known}"
        raise ArgumentError("library", rule, verb="have", shown=f"{found} in {shown}")
    return library


def _map_library(path: str | os.PathLike, header: dict[str, PyTree]) -> Library:
    arrays: dict[str, PyTree] = {}
    for name, (kind, shape, place) in header["arrays"].items():
        mapped = np.memmap(path, kind, "r", place, tuple(shape) or (1,))
        mapped = mapped if shape else mapped[0]
        arrays[name] = mapped if name == "rows" else np.array(mapped)
    layout = Layout(
        *(
            tuple(Face(face["axis"], face["side"], tuple(face["cells"])) for face in faces)
            for faces in (header["layout"]["outer"], header["layout"]["inner"])
        )
    )
    rows, homes = arrays.pop("rows"), arrays.pop("homes")
    parts = {f"arm.{name}": _freeze(value) for name, value in header["arm"].items()}
    setting = build_tree(Setting, "", arrays | parts)
    return library_of(rows, homes, layout, setting)


def _named_parts() -> list[str]:
    """Return the names of an arm's fields that are not arrays."""
    fields = dataclasses.fields(Arm)
    return [field.name for field in fields if not field.metadata.get("pytree_node", True)]


def _freeze(value: PyTree) -> PyTree:
    return tuple(map(_freeze, value)) if isinstance(value, list) else value


def _to_stored(leaf: ArrayLike) -> np.ndarray:
    value = np.ascontiguousarray(leaf)
    return value.astype({"f": "<f4", "b": "|b1"}.get(value.dtype.kind, "<i4")).reshape(
        np.shape(leaf)
    )


def _align(size: int) -> int:
    return -(-size // _ALIGNED) * _ALIGNED
