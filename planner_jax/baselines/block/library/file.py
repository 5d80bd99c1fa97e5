"""Library files: a text header, then arrays; no pickle.

    planner-jax block library 3 CRC
    {"fingerprint": ..., "layout": ..., "arm": ..., "arrays": ...}

CRC is the CRC-32 checksum of the second line, in eight hexadecimal digits. The second line is JSON.
It holds a hash of arm and scene, the cells of both boxes around the arm, the fields of the arm that
are not arrays, and for every array by name its type, its shape and the checksum of its bytes.

Blanks pad the header, and zeros each array, to a multiple of 64 bytes. The arrays follow in the
order of the header, in C order, of the types <f4, <i4 and |b1. All arrays are read and checked when
a library is loaded, since a mapped file could be truncated while its motions are used.
"""

import dataclasses
import json
import math
import os
import zlib
from typing import BinaryIO

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
from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.core.plan_files import UNREADABLE, build_tree, leaves_by_name
from planner_jax.host.files import open_plain, replacing
from planner_jax.robot.arm import Arm

VERSION = 3
# Version of the planning method. An interrupted build continues only with the same version.
BUILD_VERSION = 1
LARGEST = 1 << 28  # [B] greatest size of a file
_MAGIC = "planner-jax block library"
_ALIGNED, _LONGEST = 64, 1 << 20  # [B] alignment of arrays; longest line of the header
_TYPES = ("<f4", "<i4", "|b1")


def save_library(path: str | os.PathLike, library: Library) -> None:
    """Write a library of stored motions to a file atomically, in the format of this module.

    Raises:
        OSError: the file cannot be written.
    """
    table, setting = library.table, library.setting
    arrays = {"rows": np.asarray(table.rows, "<f4"), "homes": np.asarray(table.homes, "<f4")}
    arrays |= {name: _to_stored(leaf) for name, leaf in leaves_by_name(setting).items()}
    blocks = [array.tobytes() + bytes(-array.nbytes % _ALIGNED) for array in arrays.values()]
    header = {
        "fingerprint": fingerprint(setting),
        "layout": dataclasses.asdict(table.layout),
        "arm": {name: getattr(setting.arm, name) for name in _named_parts()},
        "arrays": {
            name: [array.dtype.str, array.shape, zlib.crc32(block)]
            for (name, array), block in zip(arrays.items(), blocks, strict=True)
        },
    }
    text = json.dumps(header).encode()
    text += b" " * (-(len(_first_line(text)) + len(text) + 1) % _ALIGNED) + b"\n"
    with replacing(path) as scratch, open(scratch, "wb") as file:
        file.writelines([_first_line(text), text, *blocks])


def load_library(path: str | os.PathLike) -> Library:
    """Load a library that `save_library` wrote, and check every byte of the file.

    Raises:
        ArgumentError: the file is missing, damaged, of another version, or not a library.
    """
    shown = repr(os.fspath(path))
    try:
        with open_plain(path, LARGEST) as file:
            return _read_library(file, shown)
    except OSError as error:
        hint = f"`planner-jax library build {os.fspath(path)}` makes one"
        shown = f"{shown} ({error.strerror}); {hint}"
        raise ArgumentError("library", "a file", shown=shown) from None


def _read_library(file: BinaryIO, shown: str) -> Library:
    first, second = file.readline(_LONGEST), file.readline(_LONGEST)
    magic, version = first[: len(_MAGIC) + 1], first[len(_MAGIC) + 1 :].split(b" ")[0]
    is_library = magic == f"{_MAGIC} ".encode()
    require(is_library, "library", "a file of a block library", shown=shown)
    found = f"version {version.decode('latin-1').strip()} in {shown}"
    require(version == b"%d" % VERSION, "library", f"of version {VERSION}", shown=found)
    damage = f"a whole file, {shown} is cut off or damaged"
    require(first == _first_line(second), "library", damage, shown="")
    try:
        header = json.loads(second)
        sizes = [_size(kind, shape) for kind, shape, _ in header["arrays"].values()]
        size, whole = os.fstat(file.fileno()).st_size, file.tell() + sum(map(_align, sizes))
        rule = f"a whole file of {whole} bytes"
        require(size == whole, "library", rule, shown=f"{size} in {shown}")
        arrays: dict[str, PyTree] = {}
        described = header["arrays"].items()
        for (name, (kind, shape, checksum)), size in zip(described, sizes, strict=True):
            block = file.read(_align(size))
            require(zlib.crc32(block) == checksum, "library", f"{damage} in {name}", shown="")
            arrays[name] = np.frombuffer(block, np.uint8, size).view(kind).reshape(shape)
        return _build_library(header, arrays, shown)
    except ArgumentError:
        raise
    except (*UNREADABLE, IndexError, AttributeError, OverflowError) as error:
        raise ArgumentError("library", f"{damage} ({type(error).__name__})", shown="") from None


def _size(kind: str, shape: list[int]) -> int:
    """Return the size [B] of an array; raise `ValueError` for another type or a wrong shape."""
    is_sound = len(shape) <= 8 and all(type(num) is int and 0 <= num <= LARGEST for num in shape)
    if kind not in _TYPES or not is_sound:
        raise ValueError
    return np.dtype(kind).itemsize * math.prod(shape)


def _build_library(header: dict[str, PyTree], arrays: dict[str, PyTree], shown: str) -> Library:
    layout = Layout(
        *(
            tuple(Face(face["axis"], face["side"], tuple(face["cells"])) for face in faces)
            for faces in (header["layout"]["outer"], header["layout"]["inner"])
        )
    )
    rows, homes = arrays.pop("rows"), arrays.pop("homes")
    given = arrays | {f"arm.{name}": _freeze(value) for name, value in header["arm"].items()}
    setting = build_tree(Setting, "", given)
    is_sound = not given and rows.dtype == homes.dtype == np.float32 and homes.shape[1:] == (6,)
    for face in (*layout.outer, *layout.inner):
        is_sound &= face.axis in (0, 1, 2) and face.side in (-1, 1)
        is_sound &= len(face.cells) == 2 and all(type(num) is int and num > 0 for num in face.cells)
    is_sound = is_sound and pieces_of(rows) > 0
    if not is_sound or rows.shape != (len(homes), layout.num_pairs, 6 * pieces_of(rows) + 10):
        raise ValueError
    known, found = header["fingerprint"], fingerprint(setting)
    if known != found:
        shown = f"{found} in {shown}"
        raise ArgumentError("library", f"the setting {known}", verb="have", shown=shown)
    return library_of(rows, homes, layout, setting)


def _first_line(second: bytes) -> bytes:
    return f"{_MAGIC} {VERSION} {zlib.crc32(second):08x}\n".encode()


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
