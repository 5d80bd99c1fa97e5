"""What a catch planner returns."""

from flax import struct
from jax import Array

from planner_jax.robot.quadrotor_plan import QuadrotorPlan
from planner_jax.task.catch.case import CatchChoice


@struct.dataclass
class CatchPlan(QuadrotorPlan):
    """One plan, or a batch of them with a leading axis on every leaf.

    The trajectory has N * M pieces, M up to each catch. Where fewer than N targets are
    present, the last pieces have no duration and stay where the last catch was made.
    """

    order: Array  # (N,) int32, which target is caught first, second, ...
    decided_times: Array  # (N,) [s], of the catches in that order, as the decision had them
    times: Array  # (N,) [s], of the catches in that order; absent targets repeat the last

    @property
    def choice(self) -> CatchChoice:
        """What was decided."""
        return CatchChoice(order=self.order, times=self.decided_times)
