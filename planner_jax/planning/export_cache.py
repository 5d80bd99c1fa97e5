"""Programs as they were traced, kept from process to process.

Where JAX keeps what it compiles it looks for a program by its text, for which the program has to
be traced: of a planner that takes seconds. Here the text is kept as well. It is looked for by all
that it follows from: what is traced and for which arguments, this library's code, the versions of
the packages that trace, and their settings.
"""

import functools
import hashlib
import importlib.metadata
import os
import pickle
import platform
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
from jax import export

from planner_jax.host.files import replacing

FOLDER = "traced"  # in that of JAX's compiled programs
_KEPT = 64  # programs, beyond which the oldest are deleted
_TRACING = ("flax", "jax", "jaxlib", "numpy")  # packages
_CODE = Path(__file__).parents[1]
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")  # of what has no name that lasts
_DIGEST = hashlib.sha256().digest_size


def traced(
    function: Callable, described: str, arguments: tuple[Any, ...], found_out: list[Any]
) -> Callable:
    """A function compiled for arguments like these, traced only if it was not before.

    Where JAX keeps nothing, or the program cannot be kept, it is as of `jax.jit`.

    Args:
        function: pure, and made of this library's code alone.
        described: whatever it is traced for, beside the arguments' shapes.
        arguments: arrays, or lists of them.
        found_out: what tracing the function puts in there, picklable; the same is put in where
            it is not traced.
    """
    folder = jax.config.values["jax_compilation_cache_dir"]
    if folder is None or _ADDRESS.search(described):
        return jax.jit(function)
    place = Path(folder) / FOLDER / _name(function, described, arguments)
    kept = _read(place)
    if kept is None:
        try:
            made = export.export(jax.jit(function))(*arguments)
            text = bytes(made.serialize())
        except ValueError:  # it holds what only this version of a compiler knows
            return jax.jit(function)
        _write(place, pickle.dumps((text, found_out)))
        return jax.jit(made.call)
    text, found_out[:] = kept
    return jax.jit(export.deserialize(bytearray(text)).call)


def _name(function: Callable, described: str, arguments: tuple[Any, ...]) -> str:
    shapes = [(leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(arguments)]
    parts = (function.__module__, function.__qualname__, described, str(shapes), _surroundings())
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _surroundings() -> str:
    """All that programs depend on and that is no part of them."""
    versions = [f"{name} {importlib.metadata.version(name)}" for name in _TRACING]
    # Of JAX's settings those of its own cache are no part of a program.
    settings = [f"{name} {value}" for name, value in jax.config.values.items()]
    switches = [f"{name} {value}" for name, value in os.environ.items() if "PLANNER_JAX" in name]
    told = [*versions, *sorted(s for s in settings if "_cache" not in s), *sorted(switches)]
    return "\n".join([platform.python_version(), jax.default_backend(), *told, _code()])


@functools.cache
def _code() -> str:
    """Of this library's files."""
    digest = hashlib.sha256()
    for path in sorted(_files(_CODE)):
        digest.update(os.path.relpath(path, _CODE).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _files(folder: Path) -> Iterator[Path]:
    """Code, and the numbers that it reads; links lead out of the library."""
    for entry in os.scandir(folder):
        if entry.is_dir(follow_symlinks=False):
            yield from _files(Path(entry.path))
        elif entry.name.endswith((".py", ".json")):
            yield Path(entry.path)


def _read(place: Path) -> Any:
    """What was written; None of a file that is not there, or not whole."""
    try:
        data = place.read_bytes()
    except OSError:
        return None
    digest, held = data[:_DIGEST], data[_DIGEST:]
    if hashlib.sha256(held).digest() != digest:
        return None
    return pickle.loads(held)


def _write(place: Path, held: bytes) -> None:
    """Keep a program, if it can be written, and the newest of the others."""
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with replacing(place) as scratch:
            scratch.write_bytes(hashlib.sha256(held).digest() + held)
        newest = sorted(place.parent.iterdir(), key=lambda path: -path.stat().st_mtime)
        for path in newest[_KEPT:]:
            path.unlink()
    except OSError:
        return
