"""Planners that minimise: the methods that a subclass defines, and the methods that it inherits."""

import abc
import dataclasses
from collections.abc import Callable
from typing import ClassVar, Self

import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.choices import EFFORTS, require_one_of
from planner_jax.core.planner import CaseT, Planner, PlanT
from planner_jax.optimise.multistart import solve_batch, solve_round
from planner_jax.optimise.settings import (
    Curvature,
    Evaluation,
    LbfgsConfig,
    NewtonConfig,
    Round,
    Settings,
    Solver,
    Stage,
)

# Newton's method from the end of the first search.
_POLISH = NewtonConfig(
    max_steps=8,
    damping=1e-6,
    tighten=30.0,
    tolerance=1e-7,
    trusted=1e-6,
    patience=8,
    slack=256.0,
    stragglers=(0.125, 10, 10),
)
_LONG = LbfgsConfig(max_steps=300, tolerance=1e-7, patience=6)
# Newton's method after the first round, by effort.
_EFFORTS = {
    "good": NewtonConfig(max_steps=1, damping=1e-6, tolerance=2e-2, stragglers=(0.125, 2, 60)),
    "best": NewtonConfig(
        max_steps=8, damping=1e-6, tolerance=1e-7, patience=8, stragglers=(0.125, 8, 32)
    ),
}


def pending(violation: Array) -> dict[str, PyTree]:
    """Return the fields of a `Plan` before the solver sets all of them but the violation."""
    zero = jnp.zeros((), jnp.int32)
    return {
        "cost": jnp.zeros_like(violation),
        "violation": violation,
        "iterations": zero,
        "status": zero,
    }


class OptimisedPlanner(Planner[CaseT, PlanT], abc.ABC):
    """A planner by batched L-BFGS: a problem of one case and rounds of attempts at it.

    A subclass is a frozen dataclass and a pytree (`jax.tree_util.register_static` if it holds no
    arrays) with a field `rounds`. Its functions `prepare`, `guesses`, `objective` and `decode` are
    pure and for one case. They use scaled decision variables, in which the objective has curvature
    of order one.
    """

    rounds: tuple[Round, ...]  # attempts, in order
    # Vectors of Newton's method; 0 if the preconditioner is nearly the inverse of the Hessian.
    subspace: ClassVar[int] = 4
    adjoint: ClassVar[str] = "products"  # the `curvature` of `pj.gradient` by default

    @abc.abstractmethod
    def prepare(self, case: PyTree) -> PyTree:
        """Return data that every evaluation reads, such as a table of the ball's path."""

    @abc.abstractmethod
    def guesses(self, context: PyTree, num: int) -> Array:
        """Return the first `num` starting points, (num, n), best first."""

    @abc.abstractmethod
    def objective(self, point: Array, context: PyTree) -> Evaluation:
        """Return cost and largest violation at a point (n,)."""

    def curvature_at(self, point: Array, context: PyTree) -> Curvature:
        """Return the derivatives for Newton's method at a point (n,).

        By default each product with the Hessian is a derivative of the gradient, and there is no
        preconditioner.
        """
        from planner_jax.optimise.newton import by_products  # only planners that polish need it

        return by_products(lambda x: self.objective(x, context))(point)

    @abc.abstractmethod
    def decode(self, point: Array, context: PyTree) -> PyTree:
        """Return the plan at a point (n,), with its violation computed more exactly.

        `cost`, `iterations` and `status` are `pending` until the solver sets them.
        """

    def rules_out(self, context: PyTree) -> Array:
        """Return whether a bound proves that no plan exists, () bool; false by default.

        Such a case has the status `TOO_FAR` unless it is solved, and no further attempt is made.
        """
        return jnp.zeros((), bool)

    def convert_point(self, point: Array, before: "OptimisedPlanner") -> Array:
        """Return a point (n,) of the same planner with other settings in this planner's variables.

        The point is the same unless the settings change the variables.
        """
        return point

    @property
    def attempts(self) -> tuple[Round, ...]:
        """The rounds."""
        return self.rounds

    def solve(self, case: PyTree, attempt: Round) -> PyTree:
        """Return the plan of one case by one round."""
        return solve_round(self, attempt, case)

    def solve_lanes(self, cases: PyTree, attempt: Round) -> PyTree:
        """Return the plans of a batch by one round."""
        return solve_batch(self, attempt, cases)

    def settle(
        self, cases: PyTree, plan_of: Callable[[Planner, PyTree], PyTree] | None = None
    ) -> tuple[Self, PyTree]:
        """Return the planner and the cases: nothing is decided before it minimises."""
        return self, cases

    def with_settings(self, settings: Settings) -> Self:
        """Return the planner with other values of some fields; its plans keep their shapes."""
        return dataclasses.replace(self, **dict(settings))  # type: ignore[type-var]

    def with_solver(self, solver: Solver = _LONG) -> Self:
        """Return the planner with one long search from the first guess in place of its rounds."""
        return self.with_settings((("rounds", (Round(solver=solver),)),))

    def with_polish(self, solver: NewtonConfig | None = None) -> Self:
        """Return the planner whose first round continues by Newton's method.

        `solver` are settings of the method; by default it continues to the optimum.
        """
        first, *others = self.rounds
        stages = (*first.stages, Stage(first.solver, first.settings))
        first = dataclasses.replace(
            first, solver=solver or self._fit_subspace(_POLISH), stages=stages
        )
        return self.with_settings((("rounds", (first, *others)),))

    def with_effort(self, effort: str) -> Self:
        """Return the planner with a first round that continues after every limit holds.

        The rounds after the first one, for the cases that it leaves unsolved, stay as they are.

        Args:
            effort: "good" adds one iteration of Newton's method, "best" adds 8. Some of the cases
                get more while they expect a decrease of the cost by more than 2 % ("good") or
                1e-7 ("best"). "feasible" returns the planner itself.
        """
        require_one_of(EFFORTS, "effort", effort)
        return (
            self.with_polish(self._fit_subspace(_EFFORTS[effort])) if effort in _EFFORTS else self
        )

    def _fit_subspace(self, solver: NewtonConfig) -> NewtonConfig:
        """Return the settings with the number of vectors that the preconditioner needs."""
        return dataclasses.replace(solver, subspace=self.subspace)
