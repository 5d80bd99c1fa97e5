"""The driver, which runs the attempts of planners of every kind for `plan` and `solve`."""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import PyTree

from planner_jax.core.planner import Kind, Planner
from planner_jax.core.protocol import (
    Attempt,
    is_better,
    is_unsolved,
    mark_out_of_time,
    select,
    select_into,
)
from planner_jax.planning.batch import Watch, plan_batch, plan_on_host
from planner_jax.planning.programs import solve_cases, solve_one


@dataclasses.dataclass(frozen=True)
class Driver:
    """The implementation of `Drive`: with the caller's settings in `plan`, pure in `solve`."""

    chunk: int | None = None
    devices: Sequence[jax.Device] | None = None  # pyright: ignore[reportInvalidTypeForm]
    watch: Watch = dataclasses.field(default_factory=Watch)
    is_pure: bool = False  # for use inside a compiled program

    @property
    def is_over(self) -> bool:
        """True if the caller's time limit has passed."""
        return self.watch.is_over

    def __call__(
        self, planner: Planner, cases: PyTree, attempts: Sequence[Attempt] | None = None
    ) -> tuple[PyTree, PyTree]:
        """Return plans of one case or a batch, and numbers that are zero if all are solved."""
        if planner.kind is Kind.COMPOSITE:
            plans = planner.plan_by(self, cases)
            return plans, is_unsolved(plans.status)
        attempts = attempts or planner.attempts
        if self.is_pure:
            plans = _plan_purely(planner, attempts, cases)
            return plans, is_unsolved(plans.status)
        if planner.kind is Kind.HOST:
            return plan_on_host(planner, attempts, cases, self.watch)
        if cases.batch_shape == ():
            plans = _plan_one(planner, attempts, cases, self.watch)
            return plans, is_unsolved(int(plans.status))
        return plan_batch(planner, attempts, cases, self.chunk, self.devices, self.watch)

    def plan_again(
        self, plan_of: Callable[[PyTree], PyTree], cases: PyTree, plans: PyTree, left: PyTree
    ) -> PyTree:
        """Return plans (B,) after another try at the cases where `left` is true; see `Drive`."""
        if self.is_pure:
            again = lambda plans: select(plan_of(cases), plans, left)  # noqa: E731
            return lax.cond(jnp.any(left), again, lambda plans: plans, plans)
        lanes = np.flatnonzero(left)
        if not lanes.size:
            return plans
        if self.is_over:
            return mark_out_of_time(plans, left)
        return select_into(plans, plan_of(jax.tree.map(lambda leaf: leaf[lanes], cases)), lanes)


def _plan_one(planner: Planner, attempts: Sequence[Attempt], case: PyTree, watch: Watch) -> PyTree:
    """Return the plan of one case: make attempts until one solves the case or the time is over."""
    best: PyTree = None
    for attempt in attempts:
        if best is not None and not attempt.is_due(best):
            continue
        if best is not None and watch.is_over:
            return mark_out_of_time(best, True)
        watch.report(planner, attempt, 0, 1)
        plan = solve_one(planner, case, attempt)
        watch.report(planner, attempt, 1, 1)
        if best is None or is_better(plan, best):
            best = plan
        if not is_unsolved(int(best.status)):  # an int is checked faster than an array
            break
    return best


def _plan_purely(planner: Planner, attempts: Sequence[Attempt], cases: PyTree) -> PyTree:
    """Return plans as jax arrays. An attempt is made at all cases if it is due for at least one."""
    require_pure(planner)
    first, *others = attempts
    plans = solve_cases(planner, cases, first)
    for attempt in others:
        due = attempt.is_due(plans)
        again = lambda plans, attempt=attempt, due=due: select(  # noqa: E731
            solve_cases(planner, cases, attempt), plans, due
        )
        plans = lax.cond(jnp.any(due), again, lambda plans: plans, plans)
    return plans


def require_pure(planner: Planner) -> None:
    """Raise `TypeError` for a planner that runs on the host, outside of compiled programs."""
    if planner.kind is Kind.HOST:
        raise TypeError(
            f"{type(planner).__name__} works on the host: call pj.plan outside compiled functions"
        )
