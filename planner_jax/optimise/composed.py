"""The base class of problems whose plans are composed of minima of other problems."""

import abc
from typing import ClassVar

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.planner import CaseT, PlanT
from planner_jax.core.protocol import is_solved, status_of
from planner_jax.optimise.near import NearPlan
from planner_jax.optimise.settings import Evaluation


class Composed(NearPlan[CaseT, PlanT]):
    """A problem whose plan depends on K minima, each of a problem of its own.

    The case of one problem may contain the minimum of another one, so that the minima together
    minimise no common cost. `find_minimum` returns all minima in one vector (n,). `compose`
    differentiates them by `implicit_point`.
    """

    needs_double: ClassVar[bool] = True

    @abc.abstractmethod
    def num_minima(self, case: PyTree) -> int:
        """Return the number K of minima."""

    @abc.abstractmethod
    def compose(self, point: Array, case: PyTree, meters: Array) -> PyTree:
        """Return the plan of the minima `point` (n,), with derivatives by the case; pure.

        Each of the K minima is an `implicit_point` with one row of `meters` (K, 2) as its `meter`.
        """

    def prepare(self, case: PyTree) -> PyTree:
        """Return the case."""
        return case

    def objective(self, point: Array, context: PyTree) -> Evaluation:
        """Return cost and violation of the plan; as a function of the point, the cost is least."""
        plan, known = self.decode(point, context), lax.stop_gradient(point)
        return Evaluation(plan.cost + 0.5 * jnp.sum((point - known) ** 2), plan.violation)

    def decode(self, point: Array, context: PyTree) -> PyTree:
        """Return the plan of the minima `point` (n,)."""
        meters = jnp.zeros((self.num_minima(context), 2), point.dtype)
        return self.compose(lax.stop_gradient(point), context, meters)

    def is_kept(self, plan: PyTree) -> Array:
        """Return whether a plan keeps all limits, () bool."""
        return is_solved(status_of(plan.cost, plan.violation, True))
