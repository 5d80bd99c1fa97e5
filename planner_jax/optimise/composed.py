"""The base class of problems whose plans are composed of minima of other problems."""

import abc
from typing import ClassVar

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.planner import CaseT, PlanT
from planner_jax.core.protocol import is_solved, status_of
from planner_jax.optimise.efforts import NO_SEARCH
from planner_jax.optimise.planner import Problem
from planner_jax.optimise.settings import Attempts, Evaluation


class Composed(Problem[CaseT, PlanT]):
    """A problem whose plan depends on K minima, each of a problem of its own.

    The case of one problem may contain the minimum of another one, so that the minima together
    minimise no common cost. `find_minima` returns all minima in one vector (n,), which no search
    changes. `compose` differentiates them by `implicit_point`.
    """

    needs_double: ClassVar[bool] = True
    guesses_minima: ClassVar[bool] = True
    attempts: ClassVar[Attempts] = NO_SEARCH

    @abc.abstractmethod
    def num_minima(self, case: PyTree) -> int:
        """Return the number K of minima."""

    @abc.abstractmethod
    def find_minima(self, case: PyTree) -> Array:
        """Return all minima of a case that is constant, in one vector (n,); pure."""

    @abc.abstractmethod
    def compose(self, point: Array, case: PyTree, meters: Array) -> PyTree:
        """Return the plan of the minima `point` (n,), with derivatives by the case; pure.

        Each of the K minima is an `implicit_point` with one row of `meters` (K, 2) as its `meter`.
        """

    def prepare(self, case: PyTree) -> PyTree:
        """Return the case."""
        return case

    def guesses(self, context: PyTree, num: int) -> Array:
        """Return the minima in `num` equal rows, (num, n), because they are known."""
        point = self.find_minima(lax.stop_gradient(context))
        return jnp.broadcast_to(point, (num, point.size))

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
