"""Run-time numbers of compiled programs, and the platform for which a program is traced.

The settings of a planner's attempt (search), such as its number of iterations, are mostly numbers.
If these are arguments of a compiled program, all attempts of a planner share one program.
"""

import contextlib
import contextvars
import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np
from jax.extend.backend import backends
from jax.typing import ArrayLike

Settings = TypeVar("Settings")
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Options = dict[str, bool]  # options of XLA with which a program is compiled
Treedef = Any  # a PyTreeDef, whose class JAX hides from type checkers

_RUN_TIME: set[type] = set()
_ARRAYS = (jax.Array, np.ndarray, np.generic)
# Before version 0.11 of JAX, XLA also has an older code generator for CPUs. It needs 40 % less time
# to compile. Its programs for a hit or catch are as fast, and steps of an arm in MJX far faster.
_IS_OLD = jax.__version_info__ < (0, 11)
QUICK_OPTIONS: Options = {"xla_cpu_use_fusion_emitters": False} if _IS_OLD else {}


def quick_options() -> Options:
    """Return options of XLA that shorten the compilation of your own function on a CPU.

    They are an argument of `jax.jit`, as in  jax.jit(f, compiler_options=pj.quick_options()) , and
    suit loops over single cases: batches take about a tenth longer. With JAX 0.11 and later, and on
    a GPU, there are no such options, and the dictionary is empty.
    """
    return dict(QUICK_OPTIONS) if jax.default_backend() == "cpu" else {}


def with_run_time_numbers(*names: str) -> Callable[[type[Settings]], type[Settings]]:
    """Make a frozen dataclass a pytree whose leaves are the fields with these names.

    Fields that hold objects of other decorated classes, or tuples of them, become subtrees. Other
    fields are static and must be hashable. A field that is None is static, too.
    """

    def register(cls: type[Settings]) -> type[Settings]:
        _RUN_TIME.add(cls)

        def flatten(settings: Settings) -> tuple[tuple, tuple]:
            values = vars(settings)
            inner = [key for key, value in values.items() if key in names or _is_run_time(value)]
            static = tuple((key, value) for key, value in values.items() if key not in inner)
            return tuple(values[key] for key in inner), (tuple(inner), static)

        def unflatten(aux: tuple, leaves: tuple) -> Settings:
            settings = object.__new__(cls)  # the leaves may be tracers, which no check accepts
            inner, static = aux
            for key, value in (*zip(inner, leaves, strict=True), *static):
                object.__setattr__(settings, key, value)
            return settings

        jax.tree_util.register_pytree_node(cls, flatten, unflatten)
        return cls

    return register


def _is_run_time(value: object) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(type(each) in _RUN_TIME for each in value)
    return type(value) in _RUN_TIME


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Fixed:
    """A search's settings as a static argument: JAX compiles a program for each of their values."""

    attempt: object


def cached_by_precision(load: Callable[..., Settings]) -> Callable[..., Settings]:
    """Cache the settings that a function returns, with all their numbers as jax arrays.

    The function's arguments must be hashable. Results in float32 and float64 are cached separately.
    """

    def place(leaf: ArrayLike) -> jax.Array:
        if isinstance(leaf, int) and not isinstance(leaf, bool):
            return jax.device_put(np.int32(leaf))
        return jax.device_put(leaf)

    @functools.lru_cache(maxsize=1024)
    def load_once(is_float64: bool, *args: object) -> Settings:
        with jax.ensure_compile_time_eval():
            return jax.tree.map(place, load(*args))

    @functools.wraps(load)
    def load_cached(*args: object) -> Settings:
        return load_once(bool(jax.config.jax_enable_x64), *args)  # type: ignore[attr-defined]

    return load_cached


@cached_by_precision
def place_numbers(settings: Settings) -> Settings:
    """Return settings whose numbers are jax arrays, to be passed to a compiled program."""
    return settings


def with_own_precision(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Let a function compute in float32 unless an argument holds numbers of double precision.

    With `jax_enable_x64`, constants in NumPy arrays would otherwise promote parts of a program of
    float32 cases to float64, and the branches of a `cond` would differ in type.
    """

    @functools.wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if not jax.config.jax_enable_x64 or _has_double((args, kwargs)):  # type: ignore[attr-defined]
            return function(*args, **kwargs)
        with jax.enable_x64(False):
            return function(*args, **kwargs)

    return call


def _has_double(tree: object) -> bool:
    arrays = [leaf for leaf in jax.tree.leaves(tree) if isinstance(leaf, _ARRAYS)]
    on_devices = any(leaf.dtype.itemsize == 8 for leaf in arrays if isinstance(leaf, jax.Array))
    return on_devices or any(leaf.dtype == np.float64 for leaf in arrays)


_TRACED: contextvars.ContextVar[str | None] = contextvars.ContextVar("platform", default=None)


@contextlib.contextmanager
def trace_for(platform: str) -> Iterator[None]:
    """Declare that programs traced within the `with` block run only on one platform ("cpu")."""
    token = _TRACED.set(platform)
    try:
        yield
    finally:
        _TRACED.reset(token)


def traced_platform() -> str | None:
    """Return the only platform for which a program is being traced, or None if it is unknown."""
    return _TRACED.get()


def has_only_cpu() -> bool:
    """Return whether all devices of JAX are CPUs."""
    return set(backends()) == {"cpu"}
