"""Mapping of functions of one problem over the last axis of a batch, on GPUs by CUDA kernels."""

from collections.abc import Callable
from typing import TypeVar

from planner_jax.lanes.kernels import with_kernel

__all__ = ["over_lanes", "with_kernel"]

Results = TypeVar("Results")


def over_lanes(function: Callable[..., Results]) -> Callable[..., Results]:
    """Map a function of one lane (problem of a batch) over many lanes; see `lanes.over`."""
    from planner_jax.lanes import over  # single problems do not need it

    return over.over_lanes(function)
