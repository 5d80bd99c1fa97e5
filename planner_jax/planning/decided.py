"""The planner for problems with a discrete choice, such as an order in which to meet targets."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.core import Tracer
from jaxtyping import PyTree

from planner_jax.core.decision import Decision, index_of_best
from planner_jax.core.planner import CaseT, Drive, Planner, PlanT
from planner_jax.core.planner_around import PlannerAround
from planner_jax.core.protocol import is_resident, is_solved, is_unsolved
from planner_jax.planning.programs import call_packed


@struct.dataclass
class DecidedPlanner(PlannerAround[CaseT, PlanT]):
    """A planner that first decides what cases leave open, such as an order of the targets.

    `decision` proposes several choices for each case, and `planner` plans the case with every
    choice. The solved plan with the least `decision.rank` is selected, or the plan with the least
    violation if none is solved. The planner's last attempt (search), the longest, is made only for
    cases that no choice has solved. If `planner.starts_long(cases)`, which means that even the
    first attempt takes long, every attempt after the first is made only for such cases.
    """

    decision: PyTree  # a `Decision`

    def settle(
        self, cases: PyTree, plan_of: Callable[[Planner, PyTree], PyTree] | None = None
    ) -> tuple[PyTree, PyTree]:
        """Return the inner planner, which minimises a cost, and the cases with their choices.

        `plan_of(planner, cases)` makes plans, whose choices are used. If `plan_of` is None, nothing
        is planned, and the first choices that `decision` proposes are used.
        """
        if plan_of is None:
            return self.planner.settle(first_choice(self.decision, cases))
        if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(cases)):
            self.decision.check(cases)
        choices, decided = _propose_all(self.decision, cases)
        if len(choices) > 1:
            decided = cases.with_choice(plan_of(self, cases).choice)
        return self.planner.settle(decided, plan_of)

    def plan_by(self, drive: Drive, cases: PyTree) -> PyTree:
        """Plan cases with each proposed choice by the loop of searches `drive`; return the best."""
        alone = cases.batch_shape == ()
        if not drive.is_pure:
            self.decision.check(cases)
        if alone and not drive.is_pure:
            choices, decided = _split(call_packed(_propose, None, self.decision, cases), 0), None
        else:
            choices, decided = _propose_all(self.decision, cases)
        if len(choices) == 1:
            if decided is None or not is_resident(cases):
                decided = cases.with_choice(jax.device_get(choices[0]))
            plans, unsolved = drive(self.planner, decided)
        else:
            if alone:
                cases, choices = jax.tree.map(lambda x: np.asarray(x)[None], (cases, choices))
            best = self._plan_all(drive, cases, choices)
            decided, plans = jax.tree.map(lambda leaf: leaf[0], best) if alone else best
            unsolved = is_unsolved(plans.status)
        if not drive.is_pure and not np.asarray(unsolved).any():
            return plans
        status = _explain(self.decision, decided, plans.status)
        on_devices = isinstance(plans.status, jax.Array)
        return plans.replace(status=status if on_devices else np.asarray(status))

    def _plan_all(self, drive: Drive, cases: PyTree, choices: PyTree) -> tuple[PyTree, PyTree]:
        xp = jnp if drive.is_pure else np
        num = len(choices)
        if not drive.is_pure:
            cases, choices = jax.tree.map(np.asarray, (cases, choices))
        tried = [cases.with_choice(choice) for choice in choices]
        together = jax.tree.map(lambda *leaves: xp.concatenate(leaves), *tried)
        attempts = self.planner.attempts
        at_all = 1 if self.planner.starts_long(cases) else max(len(attempts) - 1, 1)
        plans, _ = drive(self.planner, together, attempts[:at_all])
        by_choice = lambda leaf: leaf.reshape(num, -1, *leaf.shape[1:])  # noqa: E731
        for attempt in attempts[at_all:]:
            has_plan = by_choice(is_solved(plans.status)).any(axis=0)
            left = is_unsolved(plans.status) & ~xp.tile(has_plan, num)
            once_more = lambda some: drive(self.planner, some, [attempt])[0]  # noqa: B023, E731
            plans = drive.plan_again(once_more, together, plans, left)
        plans, together = jax.tree.map(lambda x: by_choice(xp.asarray(x)), (plans, together))
        chosen = index_of_best(plans, self.decision.rank(plans))
        lanes = np.arange(len(chosen))
        return jax.tree.map(lambda leaf: leaf[chosen, lanes], (together, plans))


def _propose(_: None, decision: Decision, case: PyTree) -> PyTree:
    return decision.propose(case)


def _split(choices: PyTree, axis: int) -> list[PyTree]:
    num = jax.tree.leaves(choices)[0].shape[axis]
    before = (slice(None),) * axis
    return [jax.tree.map(lambda leaf: leaf[*before, k], choices) for k in range(num)]  # noqa: B023


@jax.jit
def _propose_all(decision: Decision, cases: PyTree) -> tuple[list[PyTree], PyTree]:
    """Return a list of proposed choices, best first, and the cases with the first choice.

    The entries of the list have one choice for each case.
    """
    if cases.batch_shape == ():
        choices = _split(decision.propose(cases), 0)
    else:
        choices = _split(jax.vmap(decision.propose)(cases), 1)
    return choices, cases.with_choice(choices[0])


@jax.jit
def _explain(decision: Decision, cases: PyTree, status: Array) -> Array:
    explain = decision.explain if cases.batch_shape == () else jax.vmap(decision.explain)
    return explain(cases, status)


def first_choice(decision: Decision, cases: PyTree) -> PyTree:
    """Return cases with a decision's first choice, which derivatives treat as constant; pure."""
    return cases.with_choice(_propose_all(decision, lax.stop_gradient(cases))[0][0])
