"""The plan of a group."""

from flax import struct
from jax import Array

from planner_jax.core.protocol import Plan
from planner_jax.task.group.case import GroupChoice
from planner_jax.task.intercept.plan import InterceptPlan


@struct.dataclass
class GroupPlan(Plan):
    """One plan, or a batch of them with a leading axis on every leaf: a leg to each target.

    Every leg begins where and when the one before ends. Legs to absent targets are the last ones
    and take no time. Where a leg is not solved, those behind it take no time either. The cost is
    when the last target is met [s].
    """

    order: Array  # (N,) int32, which target is met first, second, ...
    begins: Array  # (N,) [s], when each leg begins
    legs: InterceptPlan  # leaves with a leading axis N, in that order

    @property
    def choice(self) -> GroupChoice:
        """What was decided."""
        return GroupChoice(order=self.order)
