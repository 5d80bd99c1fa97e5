"""Traced programs that one process keeps for the next.

JAX's cache of compiled programs finds a program by its text, for which the program must be traced:
of a planner that takes seconds. Here the text is kept as well. Its key is all that the text depends
on: the function and its arguments, the code of this library, the versions of the packages that
trace, and their settings.
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

FOLDER = "traced"  # in the folder of JAX's compiled programs
_KEPT = 64  # programs, beyond which the oldest are deleted
_TRACING = ("flax", "jax", "jaxlib", "numpy")  # packages
_CODE = Path(__file__).parents[1]
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")  # in the name of an object that only one process knows
_DIGEST = hashlib.sha256().digest_size


def traced(
    function: Callable, described: str, arguments: tuple[Any, ...], found_out: list[Any]
) -> Callable:
    """Return a function compiled for arguments like these, traced only if no process did before.

    Without a cache folder, or if the program cannot be kept, the function is that of `jax.jit`.

    Args:
        function: pure, and made of this library's code alone.
        described: all that the program depends on besides the shapes of the arguments.
        arguments: arrays, or lists of them.
        found_out: a list that tracing the function fills, picklable; it is filled alike where the
            function is not traced.
    """
    folder = jax.config.values["jax_compilation_cache_dir"]
    if folder is None or _ADDRESS.search(described):
        return jax.jit(function)
    path = Path(folder) / FOLDER / _key(function, described, arguments)
    kept = _read(path)
    if kept is None:
        try:
            made = export.export(jax.jit(function))(*arguments)
            text = bytes(made.serialize())
        except ValueError:  # the program holds a call that only this version of a compiler knows
            return jax.jit(function)
        _write(path, pickle.dumps((text, found_out)))
        return jax.jit(made.call)
    text, found_out[:] = kept
    return jax.jit(export.deserialize(bytearray(text)).call)


def _key(function: Callable, described: str, arguments: tuple[Any, ...]) -> str:
    """Return the file name of a program."""
    shapes = [(leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(arguments)]
    parts = (function.__module__, function.__qualname__, described, str(shapes), _surroundings())
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _surroundings() -> str:
    """Return all that programs depend on and that is no part of them."""
    versions = [f"{name} {importlib.metadata.version(name)}" for name in _TRACING]
    # JAX's settings of its own cache are no part of a program.
    settings = [f"{name} {value}" for name, value in jax.config.values.items()]
    switches = [f"{name} {value}" for name, value in os.environ.items() if "PLANNER_JAX" in name]
    lines = [*versions, *sorted(s for s in settings if "_cache" not in s), *sorted(switches)]
    return "\n".join([platform.python_version(), jax.default_backend(), *lines, _code()])


@functools.cache
def _code() -> str:
    """Return the digest of this library's files."""
    digest = hashlib.sha256()
    for path in sorted(_files(_CODE)):
        digest.update(os.path.relpath(path, _CODE).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files of code, and of numbers that it reads; links lead out of the library."""
    for entry in os.scandir(folder):
        if entry.is_dir(follow_symlinks=False):
            yield from _files(Path(entry.path))
        elif entry.name.endswith((".py", ".json")):
            yield Path(entry.path)


def _read(path: Path) -> tuple[bytes, list[Any]] | None:
    """Return what `_write` wrote; None if the file is absent or damaged."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    digest, held = data[:_DIGEST], data[_DIGEST:]
    if hashlib.sha256(held).digest() != digest:
        return None
    return pickle.loads(held)


def _write(path: Path, held: bytes) -> None:
    """Keep a program, if it can be written, and the newest of the others."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as scratch:
            scratch.write_bytes(hashlib.sha256(held).digest() + held)
        newest = sorted(path.parent.iterdir(), key=lambda path: -path.stat().st_mtime)
        for old in newest[_KEPT:]:
            old.unlink()
    except OSError:
        return
