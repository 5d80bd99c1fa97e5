"""What an intercept planner returns."""

from flax import struct
from jax import Array

from planner_jax.robot.car import CarPlan


@struct.dataclass
class InterceptPlan(CarPlan):
    """One plan, or a batch of them with a leading axis on every leaf; ends at the meeting."""

    meeting: Array  # (2,) [m], where the planner takes the target to be at the end
