"""Checks that memory and disk have room for a number of cases or rows; no import of JAX."""

import os

from planner_jax.core.errors import ArgumentError
from planner_jax.host import machine


def require_memory(name: str, num: int, bytes_each: int) -> None:
    """Raise `ArgumentError` if `num` elements of `bytes_each` bytes exceed the free memory."""
    free = machine.available_memory()
    _require_space(name, num, bytes_each, free, "which this machine has memory")


def require_disk(name: str, num: int, bytes_each: int, folder: str | os.PathLike) -> None:
    """Raise `ArgumentError` if `num` rows of `bytes_each` bytes exceed the folder's free disk."""
    _require_space(name, num, bytes_each, machine.free_disk(folder), "which the disk has room")


def _require_space(name: str, num: int, bytes_each: int, free: int | None, what: str) -> None:
    if free is not None and num * bytes_each > free:
        sizes = f"{machine.format_size(bytes_each)} each, {machine.format_size(free)} free"
        most = max(free // bytes_each, 1)
        raise ArgumentError(name, f"at most {most:,}, for {what} ({sizes})", num)
