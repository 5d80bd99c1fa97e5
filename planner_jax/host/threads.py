"""Threads that plan parts of a batch at the same time, and are kept for later calls.

A call of JAX takes milliseconds longer in a new thread than in one that has called JAX before.
"""

import contextlib
import os
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import ParamSpec, TypeVar

import jax

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

_idle: defaultdict[int, list[ThreadPoolExecutor]] = defaultdict(list)  # pools, by their size
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_idle.clear)  # a child process does not have the threads


@contextlib.contextmanager
def borrow_threads(num: int) -> Iterator[ThreadPoolExecutor]:
    """Yield a pool of `num` threads, which nobody else uses meanwhile and later calls use again."""
    pools = _idle[num]
    pool = pools.pop() if pools else ThreadPoolExecutor(num)
    try:
        yield pool
    finally:
        pools.append(pool)


def as_here(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Wrap a function so that other threads run it with this thread's `jax_enable_x64`."""
    here = jax.config.jax_enable_x64  # type: ignore[attr-defined]

    def call(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        # Within `enable_x64` JAX compiles programs again, even if the precision is unchanged.
        is_equal = jax.config.jax_enable_x64 == here  # type: ignore[attr-defined]
        with contextlib.nullcontext() if is_equal else jax.enable_x64(here):
            return function(*args, **kwargs)

    return call
