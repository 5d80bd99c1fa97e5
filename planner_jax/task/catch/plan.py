"""What a catch planner returns."""

from flax import struct
from jax import Array

from planner_jax.trajectory.polynomial import PiecewisePolynomial


@struct.dataclass
class CatchPlan:
    """One plan, or a batch of them with a leading axis on every leaf.

    The trajectory has N * M pieces, M up to each catch. Where fewer than N targets are
    present, the last pieces have no duration and stay where the last catch was made.
    """

    trajectory: PiecewisePolynomial  # of the quadrotor's propeller plane
    order: Array  # (N,) int32, which target is caught first, second, ...
    times: Array  # (N,) [s], of the catches in that order; absent targets repeat the last
    cost: Array  # (), the planner's own objective
    violation: Array  # (), largest relative excess over a limit that the planner saw; <= 0 is good
    iterations: Array  # () int32
    status: Array  # () int32, a `planner_jax.optimise.status.Status`
