"""The re-planner of all planners that minimise, with all that does not depend on the task."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.protocol import Plan
from planner_jax.optimise.around import ProblemAround
from planner_jax.optimise.planner import Problem, SearchPlanner
from planner_jax.optimise.settings import Attempt
from planner_jax.planning.replan import Replanning
from planner_jax.robot.heading import continue_heading

# Step lengths that L-BFGS tries, relative to its proposed step. Small lengths are needed, because
# the first step ignores the cost's curvature and is too long.
TRIALS = (1.0, 0.2, 0.04)


@struct.dataclass
class RemainderContext:
    """Data of a re-plan: what remains of a case, and the starting point of the search."""

    inner: PyTree  # what remains, as the inner problem prepares it
    task: Replanning
    start: Array  # (n,), the inner problem's variables for the previous plan
    # () bool, whether what remains of the previous plan is returned; None: a new plan is made.
    is_kept: PyTree = None


@dataclasses.dataclass(frozen=True)
class Remaining:
    """The functions and attempts by which the re-planner continues plans of a task."""

    plan_type: type[Plan]
    # `begin(cases, previous, elapsed, **news)` returns what remains of plans being executed.
    begin: Callable[..., Replanning]
    # `start_from(problem, task, context)` returns the point (n,) of the inner problem that is
    # nearest to the previous plan. `context` is what remains, as the inner problem prepares it.
    start_from: Callable[[PyTree, Replanning, PyTree], Array]
    attempts: tuple[Attempt, ...]
    shortest: float = 0.0  # [s], usual value of the field of `Remainder`
    # `time_left(task, context)` returns the time () [s] to the next contact, -inf if there is none.
    # `keep(task, context)` returns what remains of the previous plan. None: always a new plan.
    time_left: Callable[[Replanning, PyTree], Array] | None = None
    keep: Callable[[Replanning, PyTree], PyTree] | None = None

    def planner_of(self, problem: Problem, shortest: float | None = None) -> "Replanner":
        """Return the planner that continues from existing plans of this problem.

        `shortest` is the field of `Remainder`; None: its usual value.
        """
        least = self.shortest if shortest is None else shortest
        return Replanner(Remainder(problem, self, least), self.attempts)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Remainder(ProblemAround):
    """The problem that remains while a plan is being executed, for `pj.replan`.

    The search starts at the previous plan. If less than `shortest` [s] is left until the next
    contact, the remainder of the previous plan is returned; hits and rallies ignore `shortest`.
    """

    problem: Problem
    of_task: Remaining
    shortest: float
    case_type = Replanning

    def prepare(self, case: Replanning) -> RemainderContext:
        """Return what remains of a case, and a starting point from the previous plan."""
        now = continue_heading(case.case, case.previous, case.elapsed)
        task, context = dataclasses.replace(case, case=now), self.problem.prepare(now)
        time_left = self.of_task.time_left
        return RemainderContext(
            inner=context,
            task=task,
            start=self.of_task.start_from(self.problem, task, context),
            is_kept=None if time_left is None else time_left(task, context) < self.shortest,
        )

    def guesses(self, context: RemainderContext, num: int) -> Array:
        """Return `num` starting points: the previous plan, then guesses for a new plan."""
        first = context.start[None]
        if num == 1:
            return first
        return jnp.concatenate([first, self.problem.guesses(context.inner, num - 1)])

    def objective(self, point: Array, context: RemainderContext) -> tuple[Array, Array]:
        """Return cost and violation at n variables `point`, or of the previous plan if kept."""
        if context.is_kept is not None:
            point = jnp.where(context.is_kept, context.start, point)
        return self.problem.objective(point, context.inner)

    def decode(self, point: Array, context: RemainderContext) -> PyTree:
        """Return the plan at n variables `point`, or what remains of the previous plan if kept."""
        plan, keep = self.problem.decode(point, context.inner), self.of_task.keep
        if keep is None:
            return plan
        remainder = lambda: keep(context.task, context.inner)  # noqa: E731
        return lax.cond(context.is_kept, remainder, lambda: plan)

    @property
    def weights(self) -> tuple[str, ...]:  # type: ignore[override]
        """The inner problem's numbers of the cost that attempts may change."""
        return self.problem.weights

    def with_weights(self, weights: dict[str, PyTree]) -> "Remainder":
        """Return a copy whose inner problem has arrays in fields that are listed in `weights`."""
        return dataclasses.replace(self, problem=self.problem.with_weights(weights))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Replanner(SearchPlanner):
    """The planner for `pj.replan`, which continues from the plans that are being executed."""

    problem: Remainder

    @property
    def plan_type(self) -> type[Plan]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The class of the previous plans."""
        return self.problem.of_task.plan_type

    @property
    def inner(self) -> SearchPlanner:
        """The planner of what remains of each case, also for plans from scratch."""
        return SearchPlanner(self.problem.problem)

    def begin(self, *args: PyTree, **news: PyTree) -> Replanning:
        """Return what remains to be planned of cases whose plans are being executed."""
        return self.problem.of_task.begin(*args, **news)
