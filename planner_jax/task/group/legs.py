"""Functions that chain the legs of groups: each drive starts where the drive before it ends."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.protocol import Status, is_solved
from planner_jax.robot.car import pose_at
from planner_jax.task.group.case import CarState, InterceptGroup
from planner_jax.task.group.plan import GroupPlan
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan

# Function of the legs of B groups, which of them are needed (B,), and their position k in the
# order. It returns their plans, and further results.
PlanLegs = Callable[[InterceptCase, Array, Array | int], tuple[InterceptPlan, PyTree]]


def chain_legs(
    cases: InterceptGroup, plan_legs: PlanLegs, *, is_pure: bool
) -> tuple[GroupPlan, PyTree]:
    """Plan the legs (drives to one target) of B groups in order, by `plan_legs`.

    Returns:
        The plans of the groups, and the further results of `plan_legs`, stacked by leg. If
        `is_pure`, the legs are planned by a loop of a compiled program.
    """
    shared = cases.shared
    car = CarState(pose=shared.start, speed=shared.speed, curvature=shared.curvature)
    state = (car, jnp.zeros_like(shared.time), jnp.ones(shared.time.shape, bool))

    def leg(state: tuple, k: Array | int) -> tuple[tuple, tuple[Array, InterceptPlan, PyTree]]:
        car, begin, solved = state
        case, needed = _make_legs(cases, k, begin, car, solved)
        found, more = plan_legs(case, needed, k)
        plans = _clear_unneeded(case, found, needed)
        return _advance(plans, begin, solved, needed), (begin, plans, more)

    if is_pure:
        _, (begins, legs, more) = lax.scan(leg, state, jnp.arange(cases.num_targets))
        return _join(cases, begins, legs), more
    results = []
    for k in range(cases.num_targets):
        state, one = leg(state, k)
        results.append(one)
    begins, legs, more = jax.tree.map(lambda *leaves: jnp.stack(leaves), *results)
    return _join(cases, begins, legs), more


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
