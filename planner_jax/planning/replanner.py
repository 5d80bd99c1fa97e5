"""The base class of re-planners that minimise, with all that does not depend on the task."""

import abc
import dataclasses
from typing import Self

import jax.numpy as jnp
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.planner import PlanT
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.optimise.settings import Evaluation, Settings
from planner_jax.planning.replan import Replanning
from planner_jax.robot.heading import continue_heading


@struct.dataclass
class ReplanContext:
    """Data of a re-plan: what remains of a case, and the starting point of the search."""

    inner: PyTree  # what remains, as the inner planner prepares it
    task: Replanning
    start: Array  # (n,), the inner planner's variables for the previous plan
    # () bool, whether what remains of the previous plan is returned; None: a new plan is made.
    is_kept: PyTree = None


class Replanner(OptimisedPlanner[Replanning, PlanT], abc.ABC):
    """Base class of planners for `pj.replan`, which search from the plan that is being executed.

    A subclass is a frozen dataclass with the fields `planner`, which plans what remains of a case,
    and `rounds`. It defines `begin`, which returns what remains, and `start_from`.
    """

    case_type = Replanning
    planner: PyTree  # an `OptimisedPlanner`, whose type subclasses state

    @property
    def inner(self) -> PyTree:
        """The planner that plans what remains of each case, also for plans from scratch."""
        return self.planner

    @abc.abstractmethod
    def start_from(self, task: Replanning, context: PyTree) -> Array:
        """Return the point (n,) of the inner planner's search that is nearest to the previous plan.

        `context` is what remains of the case, as the inner planner prepares it.
        """

    def prepare(self, case: Replanning) -> ReplanContext:
        """Return what remains of a case, and a starting point from the previous plan."""
        now = continue_heading(case.case, case.previous, case.elapsed)
        task, context = dataclasses.replace(case, case=now), self.planner.prepare(now)
        return ReplanContext(inner=context, task=task, start=self.start_from(task, context))

    def guesses(self, context: ReplanContext, num: int) -> Array:
        """Return `num` starting points: the previous plan, then guesses for a new plan."""
        first = context.start[None]
        if num == 1:
            return first
        return jnp.concatenate([first, self.planner.guesses(context.inner, num - 1)])

    def objective(self, point: Array, context: ReplanContext) -> Evaluation:
        """Return the cost, and the largest relative excess over a limit, at n variables `point`."""
        return self.planner.objective(point, context.inner)

    def decode(self, point: Array, context: ReplanContext) -> PlanT:
        """Return the plan of what remains that the n decision variables `point` describe."""
        return self.planner.decode(point, context.inner)

    def with_settings(self, settings: Settings) -> Self:
        """Return a copy with these values of its fields, or of fields of the inner planner."""
        own = {name: value for name, value in settings if name in vars(self)}
        inner = self.planner.with_settings(tuple(each for each in settings if each[0] not in own))
        return dataclasses.replace(self, **{"planner": inner, **own})  # type: ignore[type-var]

    @property
    def weights(self) -> tuple[str, ...]:  # type: ignore[override]
        """The inner planner's numbers of the cost that rounds may change."""
        return self.planner.weights

    def with_weights(self, weights: dict[str, PyTree]) -> Self:
        """Return a copy whose inner planner has arrays in fields that are listed in `weights`."""
        return dataclasses.replace(self, planner=self.planner.with_weights(weights))  # type: ignore[type-var]

    def setting(self, name: str) -> PyTree:
        """Return the value of a field of this planner or, if it has none, of the inner planner."""
        return vars(self)[name] if name in vars(self) else self.planner.setting(name)
