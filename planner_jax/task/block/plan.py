"""What a block planner returns."""

from flax import struct
from jax import Array

from planner_jax.robot.arm_plan import ArmPlan


@struct.dataclass
class BlockPlan(ArmPlan):
    """One plan, or a batch of them with a leading axis on every leaf.

    The motion begins when the arm may start, at the case's `delay`, and the arm stays where it
    ends if it must be at rest there.
    """

    contact_time: Array  # () [s], when the shield meets the ball, since the ball was first seen
