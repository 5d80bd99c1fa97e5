"""Groups planned leg after leg: each target as early as it can be met, from where the last was.

A leg is an interception of its own, with the car as the leg before leaves it, and targets and
movers moved on to that time. `SpacetimeIntercept` plans it as early as it can; or where that fails,
since a car cannot always drive what a reach set of cells has as early, with the least effort. Legs
of all groups of a batch, and of all orders that are tried, are planned together: first all first
ones, then all second ones.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from planner_jax.core.planner import Drive, Planner
from planner_jax.core.protocol import Attempt, Status, is_solved, is_unsolved
from planner_jax.robot.car import pose_at
from planner_jax.task.group.case import CarState, InterceptGroup
from planner_jax.task.group.plan import GroupPlan
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.default_planner import SpacetimeIntercept
from planner_jax.task.intercept.plan import InterceptPlan

# Fewer ways than one target alone is met by: there are many legs.
_EARLY = dataclasses.replace(SpacetimeIntercept("early").attempts[0], ways=12)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class GroupIntercept(Planner):
    """A composite planner of groups whose order is decided.

    What it gives up for the sake of speed: every leg ends as early as it can, whatever that
    means for the next one.
    """

    case_type: ClassVar[type] = InterceptGroup
    attempts: ClassVar[tuple[Attempt, ...]] = (Attempt(),)  # pyright: ignore[reportIncompatibleMethodOverride]
    # One search: where it fails, others take long.
    planner: SpacetimeIntercept = SpacetimeIntercept("early", searches=(_EARLY,))
    patient: SpacetimeIntercept = SpacetimeIntercept("least")  # of legs that it leaves unsolved

    def plan_by(self, drive: Drive, cases: InterceptGroup) -> GroupPlan:
        """The plans of a batch, or of one group."""
        if cases.batch_shape == ():
            plans = self.plan_by(drive, jax.tree.map(lambda leaf: leaf[None], cases))
            return jax.tree.map(lambda leaf: leaf[0], plans)
        shared = cases.shared
        car = CarState(pose=shared.start, speed=shared.speed, curvature=shared.curvature)
        state = (car, jnp.zeros_like(shared.time), jnp.ones(shared.time.shape, bool))

        def leg(state: tuple, k: Array | int) -> tuple[tuple, tuple[Array, InterceptPlan]]:
            car, begin, fine = state
            case, wanted = _leg(cases, k, begin, car, fine)
            plans = _of_wanted(case, self._planned(drive, case, wanted), wanted)
            return _after(plans, begin, fine, wanted), (begin, plans)

        if drive.is_pure:
            _, (begins, legs) = lax.scan(leg, state, jnp.arange(cases.num_targets))
            return _joined(cases, begins, legs)
        found = []
        for k in range(cases.num_targets):
            state, one = leg(state, k)
            found.append(one)
        begins, legs = jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)
        return jax.device_get(_joined(cases, begins, legs))

    def _planned(self, drive: Drive, case: InterceptCase, wanted: Array) -> InterceptPlan:
        """Plans of the legs that are wanted, (B,) bool; what the others hold means nothing."""
        patiently = lambda some: drive(self.patient, some)[0]  # noqa: E731
        if drive.is_pure:
            plans, _ = drive(self.planner, case)
            return drive.plan_again(patiently, case, plans, wanted & _is_left(plans.status))
        case, wanted = jax.tree.map(np.asarray, (case, wanted))
        # Orders that begin alike have legs in common. Without any leg, one stands for all.
        some = np.flatnonzero(wanted) if np.any(wanted) else np.zeros(1, int)
        leaves = [leaf[some].reshape(some.size, -1) for leaf in jax.tree.leaves(case)]
        rows = np.concatenate(leaves, axis=1)
        _, first, place = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        case = jax.tree.map(lambda leaf: leaf[some[first]], case)
        plans, _ = drive(self.planner, case)
        plans = drive.plan_again(patiently, case, plans, _is_left(plans.status))
        places = np.zeros(len(wanted), int)
        places[some] = place
        return jax.tree.map(lambda leaf: leaf[places], plans)


def _is_left(status: Array) -> Array:
    """Which legs are worth another planner; it has other meeting times, and thinner bodies."""
    return is_unsolved(status) | (status == Status.NO_PATH)


@jax.jit
def _leg(
    cases: InterceptGroup, k: Array | int, begin: Array, car: CarState, fine: Array
) -> tuple[InterceptCase, Array]:
    """Return the legs to the k-th targets of the orders, and which of the legs are to be planned.

    They start at times (B,) [s] where the cars are then; `fine` (B,) bool says whether all legs
    before are solved.
    """

    def of_one(case: InterceptGroup, begin: Array, car: CarState) -> tuple[InterceptCase, Array]:
        target = case.order[k]
        return case.leg(target, begin, car), case.present[target]

    legs, present = jax.vmap(of_one)(cases, begin, car)
    return legs, present & fine


@jax.jit
def _of_wanted(cases: InterceptCase, plans: InterceptPlan, wanted: Array) -> InterceptPlan:
    """The plans (B, ...) of legs; where none is wanted, one that takes no time."""
    num = plans.speed.shape[1]
    zero = jnp.zeros_like(plans.time)
    nothing = InterceptPlan(
        cost=zero,
        violation=zero,
        iterations=jnp.zeros_like(plans.iterations),
        status=jnp.full_like(plans.status, Status.CONVERGED),
        start=cases.start,
        time=zero,
        speed=jnp.repeat(cases.speed[:, None], num, axis=1),
        curvature=jnp.repeat(cases.curvature[:, None], num, axis=1),
        meeting=plans.meeting,
    )

    def pick(plan: Array, other: Array) -> Array:
        return jnp.where(wanted.reshape(-1, *[1] * (plan.ndim - 1)), plan, other)

    return jax.tree.map(pick, plans, nothing)


@jax.jit
def _after(
    plans: InterceptPlan, begin: Array, fine: Array, wanted: Array
) -> tuple[CarState, Array, Array]:
    """Where the cars are after legs (B, ...), when (B,) [s], and whether all was solved (B,)."""

    def end(plan: InterceptPlan) -> CarState:
        return CarState(
            pose=pose_at(
                plan.start,
                jnp.where(plan.time > 0.0, plan.time, 1.0),
                plan.speed,
                plan.curvature,
                plan.time,
            ),
            speed=plan.speed[-1],
            curvature=plan.curvature[-1],
        )

    return jax.vmap(end)(plans), begin + plans.time, fine & (is_solved(plans.status) | ~wanted)


@jax.jit
def _joined(cases: InterceptGroup, begins: Array, legs: InterceptPlan) -> GroupPlan:
    """The plans of legs (N, B, ...), which begin at times (N, B) [s]."""
    begin, of_all = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), (begins, legs))
    # What the first leg that is not solved says goes for the whole; the last if all are.
    first = jnp.argmax(~is_solved(of_all.status), axis=1)
    lanes = jnp.arange(first.size)
    solved = jnp.all(is_solved(of_all.status), axis=1)
    return GroupPlan(
        cost=jnp.max(begin + of_all.time, axis=1),
        violation=jnp.where(
            solved, jnp.max(of_all.violation, axis=1), of_all.violation[lanes, first]
        ),
        iterations=jnp.sum(of_all.iterations, axis=1),
        status=of_all.status[lanes, first],
        order=cases.order,
        begins=begin,
        legs=of_all,
    )
