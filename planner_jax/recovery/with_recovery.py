"""A planner that appends a recovery trajectory to each plan of a quadrotor."""

import dataclasses
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import PyTree

from planner_jax.core.choices import RECOVERIES, require_one_of
from planner_jax.core.errors import NotOffered
from planner_jax.core.planner import CaseT, Drive, Planner, PlanT
from planner_jax.core.planner_around import PlannerAround
from planner_jax.core.protocol import Status, is_solved
from planner_jax.cost.moving import MovingKeepOut
from planner_jax.optimise.planner import SearchPlanner
from planner_jax.recovery.case import RecoveryCase, end_state
from planner_jax.recovery.planner import RecoveryProblem


@struct.dataclass
class RecoveringPlanner(PlannerAround[CaseT, PlanT]):
    """A planner of a quadrotor's task, followed by a planner of recovery trajectories.

    If the recovery exceeds a limit, the plan is searched again with a lower speed limit, for each
    fraction in `slower` of the case's speed limit. Without a recovery the plan counts as unsolved.

    Attributes:
        recovery_planner: planner of the recovery trajectories.
        slower: fractions of the case's speed limit with which plans without a recovery are searched
            again.
    """

    recovery_planner: SearchPlanner
    slower: tuple[float, ...] = struct.field(pytree_node=False, default=(0.8, 0.65, 0.5))

    def smooth(self) -> PyTree:
        """Raise `TypeError`, since `pj.gradient` cannot differentiate plans with a recovery.

        The plan and its recovery trajectory are results of two separate minimisations.
        """
        raise NotOffered(
            "plans with a recovery have no gradient, as plan and recovery are minimised one after "
            "the other: leave `recovery` out"
        )

    def plan_by(self, drive: Drive, cases: PyTree) -> PyTree:
        """Return plans with recovery trajectories, by the loop over searches `drive`."""
        if cases.batch_shape == ():
            one = self.plan_by(drive, jax.tree.map(lambda leaf: np.asarray(leaf)[None], cases))
            return jax.tree.map(lambda leaf: leaf[0], one)
        if not drive.is_pure:
            cases = jax.tree.map(np.asarray, cases)
        plans, left = self._plan_at(1.0, drive, cases)
        if not drive.is_pure:
            plans = jax.tree.map(np.array, plans)
        for factor in self.slower:
            slower = lambda some, factor=factor: self._plan_at(factor, drive, some)[0]  # noqa: E731
            plans = drive.plan_again(slower, cases, plans, left)
            left = left & ~is_solved(plans.status)
        return plans

    def _plan_at(self, factor: float, drive: Drive, cases: PyTree) -> tuple[PyTree, PyTree]:
        speed = (factor * cases.limits.speed).astype(cases.limits.speed.dtype)
        slower = dataclasses.replace(cases.limits, speed=speed)
        plans, _ = drive(self.planner, dataclasses.replace(cases, limits=slower))
        recoveries, _ = drive(self.recovery_planner, recovery_cases(cases, plans))
        xp: ModuleType = jnp if drive.is_pure else np
        whole, recovers = is_solved(plans.status), is_solved(recoveries.status)
        lacking, worst = whole & ~recovers, xp.maximum(plans.violation, recoveries.violation)
        plans = dataclasses.replace(plans, recovery=recoveries.trajectory).with_heading(cases)
        plans = dataclasses.replace(
            plans,
            violation=xp.where(whole, worst, plans.violation),
            iterations=plans.iterations + recoveries.iterations,
            status=xp.where(lacking, Status.INFEASIBLE, plans.status).astype(np.int32),
        )
        return plans, lacking


def recovery_cases(cases: PyTree, plans: PyTree) -> RecoveryCase:
    """Return the cases of recovery trajectories that start at the ends of a batch of plans."""
    states: PyTree = _end_states(plans.trajectory)
    if isinstance(plans.status, np.ndarray):
        states = np.asarray(states)
    ends = plans.trajectory.durations.sum(axis=-1)
    later = lambda x: x.later(ends) if isinstance(x, MovingKeepOut) else x  # noqa: E731
    extras: PyTree = tuple(map(later, cases.extras))
    return RecoveryCase(
        head_state=states,
        home=cases.head_state[:, 0],
        gravity=cases.gravity,
        limits=cases.limits.of_recovery(states, cases.gravity),
        extras=extras,
    )


_end_states = jax.jit(jax.vmap(end_state))


def add_recovery(planner: Planner[CaseT, PlanT], recovery: str) -> RecoveringPlanner[CaseT, PlanT]:
    """Make a planner whose plans continue from a quadrotor's hit or last catch to standstill.

    Args:
        planner: a planner whose plans have the trajectory of a quadrotor.
        recovery: "brake" for the cheapest trajectory to standstill anywhere; "home" for the
            trajectory back to the position at which the case starts.

    Raises:
        ValueError: `recovery` is neither "brake" nor "home".
    """
    require_one_of(RECOVERIES, "recovery", recovery)
    return RecoveringPlanner(planner, RecoveryProblem.planner(to=recovery))
