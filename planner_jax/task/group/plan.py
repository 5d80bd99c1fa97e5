"""The plan in which a car meets a group of targets: one interception after another."""

from flax import struct
from jax import Array

from planner_jax.core.protocol import Plan
from planner_jax.task.group.case import GroupChoice
from planner_jax.task.intercept.plan import InterceptPlan


@struct.dataclass
class GroupPlan(Plan):
    """One plan with a leg, that is a drive, to each of N targets; or a batch of plans.

    Every leg starts at the state and the time at which the previous leg ends. Legs to absent
    targets, and after an unsolved leg, have zero duration. The cost is the time [s] when the last
    target is met.

    Attributes:
        order: (N,) int32, indices of the targets in the order of the meetings.
        begins: (N,) [s], start time of each leg, in the sequence of `order`.
        legs: plans of the N legs in the sequence of `order`; leaves have a leading axis N.
    """

    order: Array
    begins: Array
    legs: InterceptPlan

    @property
    def choice(self) -> GroupChoice:
        """The order in which the plan meets its targets, for `InterceptGroup.with_choice`."""
        return GroupChoice(order=self.order)
