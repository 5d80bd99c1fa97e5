"""The default planner of the task `group`, in which one car meets several targets in an order.

A leg is the drive to one target. It starts at the time and state at which the previous leg ends.
`SpacetimeIntercept` plans each leg such that the meeting is as early as possible. If no such plan
is found, it plans the leg with the least discomfort instead. The first legs of all cases
of a batch, in all proposed orders, are planned together, then all second legs, and so on.
"""

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import jax
import numpy as np
from jax import Array

from planner_jax.core.planner import Drive, Planner
from planner_jax.core.protocol import BaseAttempt, Status, is_unsolved
from planner_jax.task.group.case import InterceptGroup
from planner_jax.task.group.legs import chain_legs
from planner_jax.task.group.plan import GroupPlan
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.default_planner import SpacetimeIntercept
from planner_jax.task.intercept.plan import InterceptPlan

if TYPE_CHECKING:
    from planner_jax.task.group.smooth import SmoothGroup

# Search for a leg (drive to one target): from 12 random paths instead of 32, as legs are many.
_EARLY = dataclasses.replace(SpacetimeIntercept("early").attempts[0], paths=12)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class GroupIntercept(Planner):
    """Planner by which a car meets targets in the order stored in a case, one leg after another.

    A leg is the drive to one target, planned by `planner`. To save computing time, every leg ends
    as early as possible, even if its end state delays the next leg.

    Attributes:
        planner: planner of every leg (drive to one target), with a single search to save time.
        patient: planner of legs that `planner` fails.
    """

    case_type: ClassVar[type] = InterceptGroup
    attempts: ClassVar[tuple[BaseAttempt, ...]] = (BaseAttempt(),)  # pyright: ignore[reportIncompatibleMethodOverride]
    planner: SpacetimeIntercept = SpacetimeIntercept("early", searches=(_EARLY,))
    patient: SpacetimeIntercept = SpacetimeIntercept("least")

    def plan_by(self, drive: Drive, cases: InterceptGroup) -> GroupPlan:
        """Plan the legs (drives to one target) in order; `drive(planner, legs)` plans a batch."""
        if cases.batch_shape == ():
            plans = self.plan_by(drive, jax.tree.map(lambda leaf: leaf[None], cases))
            return jax.tree.map(lambda leaf: leaf[0], plans)

        def plan_legs(
            legs: InterceptCase, needed: Array, _: Array | int
        ) -> tuple[InterceptPlan, None]:
            return self._plan_legs(drive, legs, needed), None

        plans, _ = chain_legs(cases, plan_legs, is_pure=drive.is_pure)
        return plans if drive.is_pure else jax.device_get(plans)

    def plan_once(self, cases: InterceptGroup) -> GroupPlan:
        """Return the plans that `pj.solve` makes."""
        from planner_jax.planning.solve import solve  # only gradients need it

        return solve(self, cases)

    def smooth(self) -> "SmoothGroup":
        """Return the problem whose minima are near this planner's plans.

        Every leg is minimised as early, also where `patient` planned it.
        """
        from planner_jax.task.group.smooth import smooth_legs  # only gradients need it

        return smooth_legs(self.planner.problem)

    def _plan_legs(self, drive: Drive, case: InterceptCase, needed: Array) -> InterceptPlan:
        patiently = lambda some: drive(self.patient, some)[0]  # noqa: E731
        if drive.is_pure:
            plans, _ = drive(self.planner, case)
            return drive.plan_again(patiently, case, plans, needed & _is_open(plans.status))
        case, needed = jax.tree.map(np.asarray, (case, needed))
        # Equal legs (drives) are planned once, because orders with the same first targets have
        # equal legs. If no leg is needed, one leg is planned, so that the arrays are not empty.
        some = np.flatnonzero(needed) if np.any(needed) else np.zeros(1, int)
        leaves = [leaf[some].reshape(some.size, -1) for leaf in jax.tree.leaves(case)]
        rows = np.concatenate(leaves, axis=1)
        _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        case = jax.tree.map(lambda leaf: leaf[some[first]], case)
        plans, _ = drive(self.planner, case)
        plans = drive.plan_again(patiently, case, plans, _is_open(plans.status))
        indices = np.zeros(len(needed), int)
        indices[some] = inverse
        return jax.tree.map(lambda leaf: leaf[indices], plans)


def _is_open(status: Array) -> Array:
    return is_unsolved(status) | (status == Status.NO_PATH)
