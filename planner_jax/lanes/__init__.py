"""Functions of one case applied to a batch, with the batch axis last, and kernels for CUDA."""

from planner_jax.lanes.attach import in_one_kernel, with_kernel
from planner_jax.lanes.over import over_lanes

__all__ = ["in_one_kernel", "over_lanes", "with_kernel"]
