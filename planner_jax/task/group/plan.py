"""The plan of a group."""

from flax import struct
from jax import Array

from planner_jax.core.protocol import Plan
from planner_jax.task.group.case import GroupChoice
from planner_jax.task.intercept.plan import InterceptPlan


@struct.dataclass
class GroupPlan(Plan):
    """One plan with a leg to each target, or a batch with a leading axis on every leaf.

    Every leg starts at the state and the time at which the previous leg ends. Legs to absent
    targets come last and take no time. Legs after an unsolved leg take no time either. The cost is
    the time [s] at which the last target is met.
    """

    order: Array  # (N,) int32, index of the target that is met first, second, ...
    begins: Array  # (N,) [s], start of each leg
    legs: InterceptPlan  # leaves with a leading axis N, in the order of `order`

    @property
    def choice(self) -> GroupChoice:
        """The order as a choice."""
        return GroupChoice(order=self.order)
