"""The base class of problems that wrap another problem."""

import dataclasses
from collections.abc import Sequence
from typing import Self

from jaxtyping import PyTree

from planner_jax.core.planner import CaseT, PlanT
from planner_jax.optimise.planner import Problem
from planner_jax.optimise.settings import Settings


class ProblemAround(Problem[CaseT, PlanT]):
    """A problem around the one in the field `problem`; it has the settings of both."""

    problem: Problem

    def with_settings(self, settings: Settings) -> Self:
        """Return a copy with these values of its fields, or of fields of the inner problem."""
        own = {name: value for name, value in settings if name in vars(self)}
        inner = self.problem.with_settings(tuple(each for each in settings if each[0] not in own))
        return dataclasses.replace(self, **{"problem": inner, **own})  # type: ignore[type-var]

    def with_usual(self, names: Sequence[str]) -> Self:
        """Return a copy whose inner problem has the default values of these fields."""
        return dataclasses.replace(self, problem=self.problem.with_usual(names))  # type: ignore[type-var]

    def setting(self, name: str) -> PyTree:
        """Return the value of a field of this problem or, if it has none, of the inner problem."""
        return vars(self)[name] if name in vars(self) else self.problem.setting(name)
