"""A planner whose plans go on to rest behind their last contact."""

import dataclasses
from collections.abc import Callable
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import PyTree

from planner_jax.core.choices import RECOVERIES, require_one_of
from planner_jax.core.planner import CaseT, Drive, Planner, PlannerAround, PlanT
from planner_jax.core.protocol import Status, is_solved
from planner_jax.recovery.case import RecoveryCase, end_state
from planner_jax.recovery.planner import RecoveryPlanner

# Where a plan ends so fast that nothing keeps the speed limit behind it, the plan is made again
# for these shares of the limit.
_SLOWER = (0.8, 0.65, 0.5)


@struct.dataclass
class RecoveringPlanner(PlannerAround[CaseT, PlanT]):
    """A composite planner: a quadrotor's planner, and one that goes on from its plans to rest.

    A plan whose recovery breaks a limit is not solved. It is then made again with less speed.
    """

    rest: RecoveryPlanner

    def settle(
        self, cases: PyTree, plan_of: Callable[[Planner, PyTree], PyTree] | None = None
    ) -> tuple[PyTree, PyTree]:
        """Raise `TypeError`: a recovery follows from its plan, and minimises for itself."""
        raise TypeError(
            "plans with a recovery have no gradient, as plan and recovery are minimised one after "
            "the other: leave `recovery` out"
        )

    def plan_by(self, drive: Drive, cases: PyTree) -> PyTree:
        """The plans of one case or of a batch, with their recoveries."""
        if cases.batch_shape == ():
            one = self.plan_by(drive, jax.tree.map(lambda leaf: np.asarray(leaf)[None], cases))
            return jax.tree.map(lambda leaf: leaf[0], one)
        if not drive.is_pure:
            cases = jax.tree.map(np.asarray, cases)
        plans, left = self._ended(drive, cases, 1.0)
        if not drive.is_pure:
            plans = jax.tree.map(np.array, plans)
        for factor in _SLOWER:
            slower = lambda some, factor=factor: self._ended(drive, some, factor)[0]  # noqa: E731
            plans = drive.plan_again(slower, cases, plans, left)
            left = left & ~is_solved(plans.status)
        return plans

    def _ended(self, drive: Drive, cases: PyTree, factor: float) -> tuple[PyTree, PyTree]:
        """Plans (B,) for a share of the speed limit, and which of them only lack a recovery."""
        limits = cases.limits
        slower = dataclasses.replace(
            limits, speed=(factor * limits.speed).astype(limits.speed.dtype)
        )
        plans, _ = drive(self.planner, dataclasses.replace(cases, limits=slower))
        recoveries, _ = drive(self.rest, recovery_cases(cases, plans))
        xp: ModuleType = jnp if drive.is_pure else np
        whole, rests = is_solved(plans.status), is_solved(recoveries.status)
        lacking = whole & ~rests
        ended = dataclasses.replace(
            plans,
            recovery=recoveries.trajectory,
            violation=xp.where(
                whole, xp.maximum(plans.violation, recoveries.violation), plans.violation
            ),
            iterations=plans.iterations + recoveries.iterations,
            status=xp.where(lacking, Status.INFEASIBLE, plans.status).astype(np.int32),
        )
        return ended, lacking


def recovery_cases(cases: PyTree, plans: PyTree) -> RecoveryCase:
    """What is left to plan behind plans (B,) of a quadrotor's cases (B,): leaves of their kind."""
    states: PyTree = _end_states(plans.trajectory)
    if isinstance(plans.status, np.ndarray):
        states = np.asarray(states)
    return RecoveryCase(
        head_state=states,
        home=cases.head_state[:, 0],
        gravity=cases.gravity,
        limits=cases.limits,
        extras=cases.extras,
    )


_end_states = jax.jit(jax.vmap(end_state))


def add_recovery(planner: Planner[CaseT, PlanT], recovery: str) -> RecoveringPlanner[CaseT, PlanT]:
    """Return a quadrotor's planner whose plans continue to standstill behind their last contact.

    Args:
        planner: of plans with the trajectory of a quadrotor.
        recovery: "brake" for the cheapest trajectory to standstill anywhere; "home" for the
            trajectory back to where the case begins.

    Raises:
        ValueError: `recovery` is something else.
    """
    require_one_of(RECOVERIES, "recovery", recovery)
    return RecoveringPlanner(planner, RecoveryPlanner(to=recovery))
