"""A planner that first has a decision taken: in what order, when, which of several."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jax.core import Tracer

from planner_jax.core.planner import CaseT, Drive, Planner, PlanT
from planner_jax.core.protocol import Decision, is_resident, is_solved, is_unsolved
from planner_jax.core.select import index_of_best
from planner_jax.planning.programs import call_packed


@struct.dataclass
class DecidedPlanner(Planner[CaseT, PlanT]):
    """A composite planner: a decision proposes choices, a planner plans every one of them.

    Of several choices the solved one of least `decision.rank` is kept, or the one of least
    violation where none is solved. The planner's last attempt, its longest, is for cases of
    which no choice is solved by then; all but the first are of a planner that says by
    `starts_long(cases)` that this one is long, too.
    """

    planner: Planner[CaseT, PlanT]
    decision: Any  # a `Decision`

    @property
    def case_type(self) -> type:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The class of the planner's cases."""
        return self.planner.case_type

    @property
    def inner(self) -> Planner:
        """The planner of decided cases."""
        return self.planner

    def replanner(self) -> Planner:
        """Return the planner's: the order of the plan that is carried out is kept."""
        return self.planner.replanner()

    def settle(
        self, cases: Any, plan_of: Callable[[Planner, Any], Any] | None = None
    ) -> tuple[Any, Any]:
        """Return what minimises, and the cases with the choice that planning all of them takes.

        Without `plan_of` it is the decision's first choice.
        """
        if plan_of is None:
            return self.planner.settle(first_choice(self.decision, cases))
        only = self.only_choice(cases)
        choice = plan_of(self, cases).choice if only is None else only
        return self.planner.settle(cases.decided(choice), plan_of)

    def only_choice(self, cases: Any) -> Any:
        """The choice about every case if the decision leaves but one, or else None."""
        if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(cases)):
            self.decision.check(cases)
        choices = _proposals(self.decision, cases)
        return choices[0] if len(choices) == 1 else None

    def plan_by(self, drive: Drive, cases: Any) -> Any:
        """The plans of one case or of a batch, with what was decided in them."""
        if not drive.is_pure:
            self.decision.check(cases)
        choices = self._proposed(drive, cases)
        if len(choices) == 1:
            decided = cases.decided(
                choices[0] if is_resident(cases) else jax.device_get(choices[0])
            )
            plans, unsolved = drive(self.planner, decided)
        elif cases.batch_shape == ():
            one = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (cases, choices))
            best = self._best_choice(drive, *one)
            decided, plans = jax.tree.map(lambda leaf: leaf[0], best)
            unsolved = is_unsolved(plans.status)
        else:
            decided, plans = self._best_choice(drive, cases, choices)
            unsolved = is_unsolved(plans.status)
        if not drive.is_pure and not np.any(unsolved):
            return plans
        status = _explained(self.decision, decided, plans.status)
        on_devices = isinstance(plans.status, jax.Array)
        return plans.replace(status=status if on_devices else np.asarray(status))

    def _proposed(self, drive: Drive, cases: Any) -> list[Any]:
        """The first choice of one case or of each of a batch, the second, ..."""
        if drive.is_pure or cases.batch_shape != ():
            return _proposals(self.decision, cases)
        return _each(call_packed(_propose, None, self.decision, cases))

    def _best_choice(self, drive: Drive, cases: Any, choices: Any) -> tuple[Any, Any]:
        """The cases as decided and their plans, after all choices have been planned together."""
        xp: Any = jnp if drive.is_pure else np
        num = len(choices)
        if not drive.is_pure:
            cases, choices = jax.tree.map(np.asarray, (cases, choices))
        tried = [cases.decided(choice) for choice in choices]
        together = jax.tree.map(lambda *leaves: xp.concatenate(leaves), *tried)
        attempts = self.planner.attempts
        at_all = 1 if self.planner.starts_long(cases) else max(len(attempts) - 1, 1)
        plans, _ = drive(self.planner, together, attempts[:at_all])
        of_case = lambda leaf: leaf.reshape(num, -1, *leaf.shape[1:])  # noqa: E731
        for attempt in attempts[at_all:]:
            has_plan = of_case(is_solved(plans.status)).any(axis=0)
            left = is_unsolved(plans.status) & ~xp.tile(has_plan, num)
            once_more = lambda some: drive(self.planner, some, [attempt])[0]  # noqa: B023, E731
            plans = drive.plan_again(once_more, together, plans, left)
        plans, together = jax.tree.map(lambda x: of_case(xp.asarray(x)), (plans, together))
        chosen = index_of_best(plans, self.decision.rank(plans))
        lanes = np.arange(len(chosen))
        return jax.tree.map(lambda leaf: leaf[chosen, lanes], (together, plans))


def _propose(_: None, decision: Any, case: Any) -> Any:
    return decision.propose(case)


def _each(choices: Any) -> list[Any]:
    """Choices (F, ...) one by one."""
    num = jax.tree.leaves(choices)[0].shape[0]
    return [jax.tree.map(lambda leaf: leaf[k], choices) for k in range(num)]  # noqa: B023


@jax.jit
def _proposals(decision: Any, cases: Any) -> list[Any]:
    """The first choice of one case or of each of a batch, the second, ..."""
    if cases.batch_shape == ():
        return _each(decision.propose(cases))
    choices = jax.vmap(decision.propose)(cases)
    num = jax.tree.leaves(choices)[0].shape[1]
    return [jax.tree.map(lambda leaf: leaf[:, k], choices) for k in range(num)]  # noqa: B023


@jax.jit
def _explained(decision: Any, cases: Any, status: Array) -> Array:
    """The status of one case or of each of a batch; of the unsolved, what the decision knows."""
    explain = decision.explain if cases.batch_shape == () else jax.vmap(decision.explain)
    return explain(cases, status)


def first_choice(decision: Decision, cases: Any) -> Any:
    """The cases with a decision's first choice, without planning; one case or a batch.

    It is pure, and constant to derivatives.
    """
    return cases.decided(_proposals(decision, lax.stop_gradient(cases))[0])
