"""Traced programs on the disk, so that later processes need not trace the library's functions.

JAX finds a program in its cache of compiled programs only after it has traced and lowered a
function, which takes up to a second for each planner. This module stores the lowered program beside
that cache, in the format of `jax.export`. The name of a program's file is a digest of all that
determines the program: the library's files, versions and settings of JAX, the device, the function,
and its arguments' structures, static values, shapes and types. A program that contains functions or
classes of another package is not stored, because the digest would not change with that package.
"""

import ast
import contextlib
import dataclasses
import enum
import functools
import hashlib
import json
import operator
import os
import sys
import threading
import time
import types
from collections.abc import Callable, Hashable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array, export
from jax.extend.backend import backends
from jax.stages import Wrapped
from jax.tree_util import PyTreeDef, default_registry
from jaxtyping import PyTree

from planner_jax.core.compiled import Options, Treedef, trace_for
from planner_jax.host.compile_cache import is_on

_LEAF, _NONE = map(jax.tree.structure, (0, None))
MOST = 300  # number of stored programs above which the oldest are deleted; each has about 0.5 MB
_PACKAGE = __name__.partition(".")[0]
_FILES = Path(__file__).resolve().parents[1]
_STARTED = time.time()  # [s], about the time when this process read the library's files
Layout = Sequence[Any]  # shapes and types of arrays, as `jax.typeof` returns them
# Settings of JAX that can change the program to which a function is traced, or make its trace fail.
_read_settings = operator.attrgetter(
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_random_seed_offset",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_use_direct_linearize",
    "jax_check_tracer_leaks",
    "jax_debug_nans",
)
# `jax.export` by default rejects Triton kernels of Pallas, since another version of JAX may not run
# them. Here they are allowed, since a stored program is used only by the version that stored it.
_CHECKS = tuple(
    export.DisabledSafetyCheck.custom_call(name)
    for name in ("__gpu$xla.gpu.triton", "triton_kernel_call", "triton_kernel_call_ffi")
)


@dataclasses.dataclass
class Results:
    """Structure, shapes and types of a program's results; known when its function was traced."""

    tree: Treedef = None
    shapes: list[tuple[int, ...]] = dataclasses.field(default_factory=list)
    dtypes: list[np.dtype] = dataclasses.field(default_factory=list)

    def flatten(self, found: PyTree) -> list[Array]:
        """Return the leaves of a traced function's results, and store how they are structured."""
        leaves, self.tree = jax.tree.flatten(found)
        self.shapes = [leaf.shape for leaf in leaves]
        self.dtypes = [leaf.dtype for leaf in leaves]
        return leaves

    def to_json(self) -> list:
        """Return a description that JSON can write; raise `_NotStoredError` if there is none."""
        described = _tree_to_json(self.tree)
        try:
            same = _tree_from_json(described) == self.tree
        except (ValueError, SyntaxError):  # static values whose `repr` is no literal
            same = False
        if not same:
            raise _NotStoredError
        return [described, self.shapes, [dtype.name for dtype in self.dtypes]]

    def load_json(self, described: list) -> None:
        """Set the fields from a description that `to_json` returned."""
        tree, shapes, dtypes = described
        self.tree = _tree_from_json(tree)
        self.shapes = [tuple(shape) for shape in shapes]
        self.dtypes = [np.dtype(name) for name in dtypes]


class Stored:
    """A pure function `function(static, *trees)` whose traced programs are stored on the disk.

    `static` is hashable. Each `static` and each structure and layout of the trees has a program,
    which is compiled for one device of the kind `platform`, "cpu" for example.
    """

    def __init__(self, function: Callable[..., PyTree], options: Options | None = None) -> None:
        self._function, self._options = function, options
        self._load, self._lock = functools.cache(self._load_once), threading.Lock()

    def __call__(self, platform: str, static: Hashable, *trees: PyTree) -> PyTree:
        """Return `function(static, *trees)`; the trees are arrays on a device of the platform."""
        leaves, tree = jax.tree.flatten(trees)
        layout = tuple([jax.typeof(leaf) for leaf in leaves])
        with self._lock:  # threads that start together share one program
            run, results = self._load(platform, static, tree, layout, settings())
        found = run(*leaves)  # the first call may trace, which sets `results`
        return jax.tree.unflatten(results.tree, found)

    def _load_once(
        self, platform: str, static: Hashable, tree: Treedef, layout: Layout, _: Hashable
    ) -> tuple[Callable[..., list[Array]], Results]:
        results = Results()

        def run(*leaves: Array) -> list[Array]:
            with trace_for(platform):
                return results.flatten(self._function(static, *jax.tree.unflatten(tree, leaves)))

        run.__name__ = self._function.__name__
        identity = self._function, static, tree
        return load_or_trace(run, layout, identity, results, platform, self._options), results


def load_or_trace(
    run: Callable[..., PyTree],
    layout: Layout,
    identity: tuple,
    results: Results,
    platform: str,
    options: Options | None,
) -> Callable[..., PyTree]:
    """Return a compiled function, whose program is read from the disk or stored there.

    Args:
        run: pure function of arrays. While it is traced, it calls `results.flatten`.
        layout: shapes and types of its arguments.
        identity: all that determines the function beside the library's files; any nested tuple.
        results: description of the results; it is complete when the returned function has run.
        platform: the only platform on which the returned function runs.
        options: XLA's options for compiling.
    """
    usual = jax.jit(run, compiler_options=options)
    folder = _folder()
    if folder is None:
        return usual
    with contextlib.suppress(_NotStoredError):
        path = folder / _digest(identity, layout, platform)
        content = _read(path, results)
        if content is None:
            content = _export(usual, layout, platform)
            _write(path, content, results)
        call = export.deserialize(bytearray(content)).call

        def call_stored(*arguments: Array) -> PyTree:
            return call(*arguments)

        call_stored.__name__ = run.__name__
        return jax.jit(call_stored, compiler_options=options)
    return usual


def settings() -> tuple:
    """Return the settings of JAX that can change a traced program."""
    return _read_settings(jax.config)


class _NotStoredError(Exception):
    """Error: a program cannot be stored, or contains code of another package."""


def _folder() -> Path | None:
    """Return the folder of traced programs in JAX's cache; None if the cache is off or remote."""
    chosen = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return Path(chosen, "traced") if chosen and is_on() and "://" not in str(chosen) else None


def _export(function: Wrapped, layout: Layout, platform: str) -> bytes:
    shapes = [
        jax.ShapeDtypeStruct(each.shape, each.dtype, weak_type=each.weak_type) for each in layout
    ]
    is_default = platform == jax.default_backend()
    kind = export.default_export_platform() if is_default else platform  # such as "cuda"
    try:
        exported = export.export(function, platforms=[kind], disabled_checks=_CHECKS)(*shapes)
        return bytes(exported.serialize())
    except (TypeError, ValueError, NotImplementedError) as error:
        raise _NotStoredError from error  # an error of the function itself is raised by its call


def _read(path: Path, results: Results) -> bytes | None:
    try:
        head, _, content = path.read_bytes().partition(b"\n")
        described = json.loads(head)
        if described["sha256"] != hashlib.sha256(content).hexdigest():
            return None
        results.load_json(described["results"])
    except (OSError, ValueError, SyntaxError, LookupError, AttributeError, TypeError):
        return None
    with contextlib.suppress(OSError):  # a folder that cannot be written
        os.utime(path)  # the programs that were used last are kept
    return content


def _write(path: Path, content: bytes, results: Results) -> None:
    described = {"sha256": hashlib.sha256(content).hexdigest(), "results": results.to_json()}
    # No flush to the disk, as `host.files` has: a damaged file is traced again.
    with contextlib.suppress(OSError):  # a folder that cannot be written
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident()}")
        scratch.write_bytes(json.dumps(described).encode() + b"\n" + content)
        scratch.replace(path)
    with contextlib.suppress(OSError):  # a file that another thread or process has renamed
        stored = sorted(path.parent.iterdir(), key=lambda each: each.stat().st_mtime)
        for oldest in stored[: max(len(stored) - MOST, 0)]:
            oldest.unlink()


def _digest(identity: tuple, layout: Layout, platform: str) -> str:
    device = jax.devices(platform)[0].device_kind
    versions = jax.__version__, metadata.version("jaxlib"), np.__version__, sys.version_info[:3]
    switches = sorted(pair for pair in os.environ.items() if pair[0].startswith("PLANNER_JAX_"))
    shapes = [(each.shape, each.dtype.name, each.weak_type) for each in layout]
    around = versions, settings(), switches, platform, device, sorted(backends()), shapes
    text = f"{_library_digest()} {around!r} {_describe(identity)}"
    return hashlib.sha256(text.encode()).hexdigest()


@functools.cache
def _library_digest() -> str:
    """Return a digest of the names, sizes and times of change of all files of the library.

    After a change of a file, this process may still run the old code. It then stores nothing.
    """
    digest = hashlib.sha256()
    for folder, folders, names in os.walk(_FILES, followlinks=True):
        folders[:] = sorted(each for each in folders if each != "__pycache__")
        for name in sorted(names):
            path = os.path.join(folder, name)
            if not os.path.exists(path):
                continue  # a link to nowhere, as editors make
            found = os.stat(path)
            if found.st_mtime > _STARTED:
                raise _NotStoredError
            digest.update(f"{folder} {name} {found.st_size} {found.st_mtime_ns}\n".encode())
    return digest.hexdigest()


def _describe(value: Any) -> str:
    """Describe a static value as a text that is the same in every process."""
    if value is None or type(value) in (bool, int, float, complex, str, bytes, range):
        return repr(value)
    if isinstance(value, PyTreeDef):
        if value == _LEAF:
            return "leaf"
        return _describe((*value.node_data(), *value.children()))
    if isinstance(value, type | types.FunctionType):
        return _name_of(value)
    name = _name_of(type(value))
    if isinstance(value, enum.Enum):
        return f"{name}.{value.name}"
    if isinstance(value, np.dtype):
        return f"{name}({value.name})"
    if isinstance(value, np.generic | np.ndarray):
        return f"{name}({value.dtype}, {value.shape}, {value.tobytes().hex()})"
    if isinstance(value, dict):
        return f"{name}{_describe(tuple(value.items()))}"
    if isinstance(value, tuple | list):
        return f"{name}({', '.join(map(_describe, value))})"
    if dataclasses.is_dataclass(value):
        return f"{name}{_describe(vars(value))}"
    raise _NotStoredError


def _name_of(thing: type | types.FunctionType) -> str:
    module, name = thing.__module__, thing.__qualname__
    if module.partition(".")[0] not in (_PACKAGE, "builtins", "numpy", "jax", "jaxlib"):
        raise _NotStoredError
    if module == "builtins":
        return name
    try:
        defined = operator.attrgetter(name)(sys.modules[module])
    except (KeyError, AttributeError):
        defined = None  # a local function or class
    if defined is not thing:
        raise _NotStoredError
    return f"{module}.{name}"


def _tree_to_json(tree: Treedef) -> list | None:
    if tree == _NONE:
        return None
    if tree == _LEAF:
        return []
    kind, fixed = tree.node_data()
    _name_of(kind)
    return [
        kind.__module__,
        kind.__qualname__,
        repr(fixed),
        [_tree_to_json(each) for each in tree.children()],
    ]


def _tree_from_json(described: list | None) -> Treedef:
    if not described:
        return _LEAF if described == [] else _NONE
    module, name, fixed, children = described
    node = operator.attrgetter(name)(sys.modules[module]), ast.literal_eval(fixed)
    trees = [_tree_from_json(each) for each in children]
    return PyTreeDef.from_node_data_and_children(default_registry, node, trees)
