"""Mapping of functions of one problem over a batch, whose axis is last, and CUDA kernels for it."""

from planner_jax.lanes.kernels import with_kernel
from planner_jax.lanes.over import over_lanes

__all__ = ["over_lanes", "with_kernel"]
