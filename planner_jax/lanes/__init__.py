"""Functions of one problem applied to a batch, with the batch axis last, and CUDA kernels."""

from planner_jax.lanes.kernels import with_kernel
from planner_jax.lanes.over import over_lanes

__all__ = ["over_lanes", "with_kernel"]
