"""Planners that minimise: the functions that a subclass defines, and those that it inherits."""

import abc
import dataclasses
from collections.abc import Callable
from typing import ClassVar, Self

import jax
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

# From where the first search ends.
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
# Of the first round, by effort.
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

    A subclass is a frozen dataclass and a pytree (`jax.tree_util.register_static` where it holds
    no arrays) with a field `rounds`. The four functions are pure and written for one case, in
    scaled decision variables in which the objective has curvature of order one.
    """

    rounds: tuple[Round, ...]  # what to try, in order
    # Vectors of Newton's method; 0 where the preconditioner of `curved` is nearly the inverse.
    subspace: ClassVar[int] = 4
    adjoint: ClassVar[str] = "products"  # the `curvature` of `pj.gradient` by default

    @abc.abstractmethod
    def prepare(self, case: PyTree) -> PyTree:
        """Return what every evaluation reads, such as the table of the ball's path."""

    @abc.abstractmethod
    def guesses(self, context: PyTree, num: int) -> Array:
        """Return the first `num` starting points, (num, n), best first."""

    @abc.abstractmethod
    def objective(self, point: Array, context: PyTree) -> Evaluation:
        """Return cost and largest violation at a point (n,)."""

    def curved(self, point: Array, context: PyTree) -> Curvature:
        """Return what Newton's method takes at a point (n,).

        By default each product with the Hessian is a derivative of the gradient, and nothing is
        known for a preconditioner.
        """
        from planner_jax.optimise.newton import by_products  # only planners that polish need it

        return by_products(lambda x: self.objective(x, context))(point)

    @abc.abstractmethod
    def decode(self, point: Array, context: PyTree) -> PyTree:
        """Return the plan at a point (n,), with its violation computed more exactly.

        The solver fills in `cost`, `iterations` and `status`; until then they are `pending`.
        """

    def rules_out(self, context: PyTree) -> Array:
        """Return whether a bound proves that no plan exists, () bool; never by default.

        Such a case has the status `TOO_FAR` unless it is solved, and no further attempt is made.
        """
        return jnp.zeros((), bool)

    def convert_point(self, point: Array, before: "OptimisedPlanner") -> Array:
        """Return a point (n,) of `before`, this planner with other settings, in own variables.

        The point is the same unless the settings change the variables of the planner.
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

    def plan_shapes(self, cases: PyTree) -> PyTree:
        """Return the shapes of plans (B, ...) of cases (B, ...); leaves are `jax.ShapeDtypeStruct`.

        Args:
            cases: leaves may be `jax.ShapeDtypeStruct`, too.
        """

        def plan(case: PyTree) -> PyTree:
            context = self.prepare(case)
            return self.decode(self.guesses(context, 1)[0], context)

        return jax.eval_shape(jax.vmap(plan), cases)

    def changed(self, settings: Settings) -> Self:
        """Return the planner with other values of some fields; its plans keep their shape."""
        return dataclasses.replace(self, **dict(settings))  # type: ignore[type-var]

    def with_solver(self, solver: Solver = _LONG) -> Self:
        """Return the planner with one long search from the first guess in place of its rounds."""
        return self.changed((("rounds", (Round(solver=solver),)),))

    def polished(self, solver: NewtonConfig | None = None) -> Self:
        """Return the planner whose first round continues by Newton's method.

        Args:
            solver: settings of the method; by default it continues to the optimum.
        """
        if solver is None:
            solver = self._suited(_POLISH)
        first, *others = self.rounds
        stages = (*first.stages, Stage(first.solver, first.settings))
        first = dataclasses.replace(first, solver=solver, stages=stages)
        return self.changed((("rounds", (first, *others)),))

    def with_effort(self, effort: str) -> Self:
        """Return the planner with a first round that continues after every limit holds.

        The rounds after the first one, for the cases that it leaves unsolved, stay as they are.

        Args:
            effort: "good" adds one iteration of Newton's method, "best" adds 8. Some of the cases
                get more while they expect a decrease of the cost by more than 2 % ("good") or
                1e-7 ("best"). "feasible" returns the planner itself.
        """
        require_one_of(EFFORTS, "effort", effort)
        return self.polished(self._suited(_EFFORTS[effort])) if effort in _EFFORTS else self

    def _suited(self, solver: NewtonConfig) -> NewtonConfig:
        """Return the settings with the number of vectors that the preconditioner needs."""
        return dataclasses.replace(solver, subspace=self.subspace)
