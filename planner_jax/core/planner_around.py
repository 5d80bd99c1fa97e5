"""A planner that wraps another planner."""

from flax import struct

from planner_jax.core.planner import CaseT, Planner, PlanT


@struct.dataclass
class PlannerAround(Planner[CaseT, PlanT]):
    """A planner that wraps one other planner for cases of the same class.

    Attributes:
        planner: the wrapped planner.
    """

    planner: Planner[CaseT, PlanT]

    @property
    def case_type(self) -> type:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The class of the planner's cases."""
        return self.planner.case_type

    @property
    def inner(self) -> Planner:
        """The wrapped planner."""
        return self.planner

    def replanner(self) -> Planner:
        """Return the planner that continues from existing plans of the wrapped planner."""
        return self.planner.replanner()
