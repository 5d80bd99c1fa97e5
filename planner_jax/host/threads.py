"""What threads have to be told of the one that asks them."""

import contextlib
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

_Given = ParamSpec("_Given")
_Found = TypeVar("_Found")


def as_here(function: Callable[_Given, _Found]) -> Callable[_Given, _Found]:
    """A function that another thread carries out in this one's type of numbers.

    `jax.enable_x64(True)` holds for the thread that says so, and for no other.
    """
    here = jax.config.jax_enable_x64  # type: ignore[attr-defined]

    def call(*args: _Given.args, **kwargs: _Given.kwargs) -> _Found:
        # Said where it is so already, it would have programs compiled anew.
        is_so = jax.config.jax_enable_x64 == here  # type: ignore[attr-defined]
        with contextlib.nullcontext() if is_so else jax.enable_x64(here):
            return function(*args, **kwargs)

    return call
