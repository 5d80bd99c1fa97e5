"""The driver, which runs the attempts of planners of every kind for `plan` and `solve`."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
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
    """The loop over a planner's attempts, for `pj.plan` or, with `is_pure`, for `pj.solve`."""

    chunk: int | None = None
    devices: Sequence[jax.Device] | None = None  # pyright: ignore[reportInvalidTypeForm]
    watch: Watch = dataclasses.field(default_factory=Watch)
    is_pure: bool = False  # for use inside a compiled program

    @property
    def is_over(self) -> bool:
        """True if the `time_limit` of `pj.plan` has passed."""
        return self.watch.is_over

    def __call__(
        self, planner: Planner, cases: PyTree, attempts: Sequence[Attempt] | None = None
    ) -> tuple[PyTree, PyTree]:
        """Plan by the listed attempts, or all; return plans, and which or how many are unsolved."""
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
        """Plan again the cases where `left` (B,) is true; return each case's better plan."""
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
        if planner.divides(attempt):
            from planner_jax.planning.searches import divide_one  # few cases need it

            plan = divide_one(planner, attempt, case)
        else:
            plan = solve_one(planner, case, attempt)
        watch.report(planner, attempt, 1, 1)
        if best is None or is_better(plan, best):
            best = plan
        if not is_unsolved(int(best.status)):  # an int is checked faster than an array
            break
    return best


def _plan_purely(planner: Planner, attempts: Sequence[Attempt], cases: PyTree) -> PyTree:
    """Return plans as jax arrays; while any case is unsolved, attempts are made at all cases."""
    require_pure(planner)
    plans: PyTree = None
    pairs = [(attempt, planner.load_attempt(attempt, cases)) for attempt in attempts]
    # Attempts of the same structure share one program, which a loop runs for each of them.
    for _, same in itertools.groupby(pairs, lambda pair: jax.tree.structure(pair[1])):
        group, loaded = zip(*same, strict=True)
        solve_by = functools.partial(_solve_by, planner, cases, loaded)
        is_start = plans is None
        if is_start:
            shapes = jax.eval_shape(solve_by, 0)
            plans = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        within = [np.inf if each.within is None else each.within for each in group]
        greatest = jnp.asarray(within, plans.violation.dtype)

        def try_next(
            k: Array, plans: PyTree, solve_by=solve_by, greatest=greatest, is_start=is_start
        ) -> PyTree:
            is_first = is_start & (k == 0)
            due = is_unsolved(plans.status) & (plans.violation <= greatest[k])

            def solve_again(plans: PyTree) -> PyTree:
                later = solve_by(k)
                better = select(later, plans, due)
                return jax.tree.map(lambda a, b: jnp.where(is_first, a, b), later, better)

            return lax.cond(is_first | jnp.any(due), solve_again, lambda plans: plans, plans)

        plans = lax.fori_loop(0, len(group), try_next, plans)
    return plans


def _solve_by(planner: Planner, cases: PyTree, loaded: Sequence[PyTree], k: Array | int) -> PyTree:
    if len(loaded) == 1:
        return solve_cases(planner, cases, loaded[0])
    return solve_cases(planner, cases, jax.tree.map(lambda *leaves: jnp.stack(leaves)[k], *loaded))


def require_pure(planner: Planner) -> None:
    """Raise `TypeError` for a planner that runs on the host, outside of compiled programs."""
    if planner.kind is Kind.HOST:
        raise TypeError(
            f"{type(planner).__name__} works on the host: call pj.plan outside compiled functions"
        )
