"""The default planner of the task `group`, in which one car meets several targets in an order.

A leg is the drive to one target. It starts at the time and state at which the previous leg ends.
`SpacetimeIntercept` plans each leg such that the meeting is as early as possible. If no such plan
is found, it plans the leg with the least discomfort instead. The first legs of all cases
of a batch, in all proposed orders, are planned together, then all second legs, and so on.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.core.planner import Drive, Planner
from planner_jax.core.protocol import BaseAttempt, Status, is_solved, is_unsolved
from planner_jax.robot.car import pose_at
from planner_jax.task.group.case import CarState, InterceptGroup
from planner_jax.task.group.plan import GroupPlan
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.default_planner import SpacetimeIntercept
from planner_jax.task.intercept.plan import InterceptPlan

# Search for a leg (drive to one target): from 12 random paths instead of 32, as legs are many.
_EARLY = dataclasses.replace(SpacetimeIntercept("early").attempts[0], paths=12)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class GroupIntercept(Planner):
    """Planner by which a car meets targets in the order stored in a case, one leg after another.

    A leg is the drive to one target, planned by `planner`. To save computing time, every leg ends
    as early as possible, even if its end state delays the next leg.
    """

    case_type: ClassVar[type] = InterceptGroup
    attempts: ClassVar[tuple[BaseAttempt, ...]] = (BaseAttempt(),)  # pyright: ignore[reportIncompatibleMethodOverride]
    # Planner of every leg (drive to one target), with a single search to save time.
    planner: SpacetimeIntercept = SpacetimeIntercept("early", searches=(_EARLY,))
    patient: SpacetimeIntercept = SpacetimeIntercept("least")  # for legs that `planner` fails

    def plan_by(self, drive: Drive, cases: InterceptGroup) -> GroupPlan:
        """Plan the legs (drives to one target) in order; `drive(planner, legs)` plans a batch."""
        if cases.batch_shape == ():
            plans = self.plan_by(drive, jax.tree.map(lambda leaf: leaf[None], cases))
            return jax.tree.map(lambda leaf: leaf[0], plans)
        shared = cases.shared
        car = CarState(pose=shared.start, speed=shared.speed, curvature=shared.curvature)
        state = (car, jnp.zeros_like(shared.time), jnp.ones(shared.time.shape, bool))

        def leg(state: tuple, k: Array | int) -> tuple[tuple, tuple[Array, InterceptPlan]]:
            car, begin, solved = state
            case, needed = _make_legs(cases, k, begin, car, solved)
            plans = _clear_unneeded(case, self._plan_legs(drive, case, needed), needed)
            return _advance(plans, begin, solved, needed), (begin, plans)

        if drive.is_pure:
            _, (begins, legs) = lax.scan(leg, state, jnp.arange(cases.num_targets))
            return _join(cases, begins, legs)
        plans = []
        for k in range(cases.num_targets):
            state, one = leg(state, k)
            plans.append(one)
        begins, legs = jax.tree.map(lambda *leaves: jnp.stack(leaves), *plans)
        return jax.device_get(_join(cases, begins, legs))

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


@jax.jit
def _make_legs(
    cases: InterceptGroup, k: Array | int, begin: Array, car: CarState, solved: Array
) -> tuple[InterceptCase, Array]:
    """Return the drives (legs) to the k-th targets of B groups; and whether each is needed, (B,).

    The legs start at the times `begin` (B,) [s] in the states `car`. A leg is needed if its target
    exists and all previous legs are solved: `solved` (B,) bool.
    """

    def of_one(case: InterceptGroup, begin: Array, car: CarState) -> tuple[InterceptCase, Array]:
        target = case.order[k]
        return case.leg(target, begin, car), case.present[target]

    legs, present = jax.vmap(of_one)(cases, begin, car)
    return legs, present & solved


@jax.jit
def _clear_unneeded(cases: InterceptCase, plans: InterceptPlan, needed: Array) -> InterceptPlan:
    num = plans.speed.shape[1]
    zero = jnp.zeros_like(plans.time)
    empty = InterceptPlan(
        cost=zero,
        violation=zero,
        iterations=jnp.zeros_like(plans.iterations),
        status=jnp.full_like(plans.status, Status.CONVERGED),
        start=cases.start,
        time=zero,
        speed=jnp.repeat(cases.speed[:, None], num, axis=1),
        curvature=jnp.repeat(cases.curvature[:, None], num, axis=1),
        origin=cases.origin,
        meeting=plans.meeting,
    )

    def pick(plan: Array, other: Array) -> Array:
        return jnp.where(needed.reshape(-1, *[1] * (plan.ndim - 1)), plan, other)

    return jax.tree.map(pick, plans, empty)


@jax.jit
def _advance(
    plans: InterceptPlan, begin: Array, solved: Array, needed: Array
) -> tuple[CarState, Array, Array]:
    def end(plan: InterceptPlan) -> CarState:
        duration = jnp.where(plan.time > 0.0, plan.time, 1.0)
        pose = pose_at(plan.start, duration, plan.speed, plan.curvature, plan.time)
        return CarState(pose=pose, speed=plan.speed[-1], curvature=plan.curvature[-1])

    return jax.vmap(end)(plans), begin + plans.time, solved & (is_solved(plans.status) | ~needed)


@jax.jit
def _join(cases: InterceptGroup, begins: Array, legs: InterceptPlan) -> GroupPlan:
    begins, legs = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), (begins, legs))
    # The status of a plan is the status of its first unsolved leg (drive to one target).
    first = jnp.argmax(~is_solved(legs.status), axis=1)
    lanes = jnp.arange(first.size)
    solved = jnp.all(is_solved(legs.status), axis=1)
    worst = jnp.max(legs.violation, axis=1)
    return GroupPlan(
        cost=jnp.max(begins + legs.time, axis=1),
        violation=jnp.where(solved, worst, legs.violation[lanes, first]),
        iterations=jnp.sum(legs.iterations, axis=1),
        status=legs.status[lanes, first],
        order=cases.order,
        begins=begins,
        legs=legs,
    )
