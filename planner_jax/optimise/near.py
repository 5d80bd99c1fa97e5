"""The base class of problems whose minimum is near a known plan, for `pj.gradient`."""

import abc
from typing import ClassVar

import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.planner import CaseT, PlanT
from planner_jax.optimise.efforts import NO_SEARCH
from planner_jax.optimise.planner import Problem, SearchPlanner
from planner_jax.optimise.settings import Attempts


@struct.dataclass
class Known:
    """The field that a class of cases gets so that a problem can start from a known plan."""

    known: PyTree  # numbers of the plan, such as its unknowns; derivatives treat them as constant


class NearPlan(Problem[CaseT, PlanT]):
    """A cost whose minimum `find_minimum` finds from a known plan, without a search.

    Its `case_type` is a subclass of a task's cases and of `Known`.
    """

    guesses_minima: ClassVar[bool] = True
    attempts: ClassVar[Attempts] = NO_SEARCH

    @abc.abstractmethod
    def known_of(self, cases: PyTree, plans: PyTree) -> PyTree:
        """Return the numbers of plans, of one case or a batch, for the field `known`."""

    @abc.abstractmethod
    def find_minimum(self, context: PyTree) -> Array:
        """Return the minimum (n,) near the plan that is stored in a case, which is constant."""

    def guesses(self, context: PyTree, num: int) -> Array:
        """Return the minimum in `num` equal rows, (num, n), because there is one known plan."""
        point = self.find_minimum(lax.stop_gradient(context))
        return jnp.broadcast_to(point, (num, *point.shape))

    def near(self, cases: PyTree, plans: PyTree) -> tuple[SearchPlanner, PyTree]:
        """Return a planner and cases by which `pj.gradient` differentiates existing plans."""
        known = lax.stop_gradient(self.known_of(cases, plans))
        return SearchPlanner(self), self.case_type(**vars(cases), known=known)
