"""Mapping of functions of one problem over the last axis of a batch, on GPUs by CUDA kernels."""

from planner_jax.lanes.kernels import with_kernel
from planner_jax.lanes.over import over_lanes

__all__ = ["over_lanes", "with_kernel"]
