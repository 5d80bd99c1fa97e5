"""The planner that minimises: what it is to write, and what it gets for that."""

import abc
import dataclasses
from collections.abc import Callable
from typing import ClassVar, Self

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

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
    """The fields that every `Plan` has, before the solver fills in all but the violation."""
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
        """What every evaluation needs and none changes, such as the ball's path table."""

    @abc.abstractmethod
    def guesses(self, context: PyTree, num: int) -> Array:
        """The first `num` starting points, (num, n), best first."""

    @abc.abstractmethod
    def objective(self, point: Array, context: PyTree) -> Evaluation:
        """Cost and largest violation at a point (n,)."""

    def curved(self, point: Array, context: PyTree) -> Curvature:
        """Evaluation at a point (n,), gradient (n,), and products with the Hessian.

        What Newton's method takes. By default each product is a derivative of the gradient, and
        nothing is known for a preconditioner.
        """
        from planner_jax.optimise.newton import by_products  # only planners that polish need it

        return by_products(lambda x: self.objective(x, context))(point)

    @abc.abstractmethod
    def decode(self, point: Array, context: PyTree) -> PyTree:
        """The plan at a point (n,), its violation looked at more closely.

        The solver fills in `cost`, `iterations` and `status`; until then they are `pending`.
        """

    def rules_out(self, context: PyTree) -> Array:
        """Whether no plan can exist, by a bound that none can beat, () bool; never, by default."""
        return jnp.zeros((), bool)

    def carried(self, point: Array, before: Self) -> Array:
        """A point (n,) of `before`, this planner with other settings, as one of this planner.

        Where the settings leave the variables what they are it is the same; only a planner whose
        settings change its variables has anything to do.
        """
        return point

    @property
    def attempts(self) -> tuple[Round, ...]:
        """The rounds."""
        return self.rounds

    def solve(self, case: PyTree, attempt: Round) -> PyTree:
        """The plan of one case by one round."""
        return solve_round(self, attempt, case)

    def solve_lanes(self, cases: PyTree, attempt: Round) -> PyTree:
        """The plans of a batch by one round."""
        return solve_batch(self, attempt, cases)

    def settle(
        self, cases: PyTree, plan_of: Callable[[Planner, PyTree], PyTree] | None = None
    ) -> tuple[Self, PyTree]:
        """Return the planner and the cases: nothing is decided before it minimises."""
        return self, cases

    def plan_shapes(self, cases: PyTree) -> PyTree:
        """What plans (B, ...) of cases (B, ...) look like, leaves `jax.ShapeDtypeStruct`.

        Args:
            cases: leaves may be `jax.ShapeDtypeStruct`, too.
        """

        def plan(case: PyTree) -> PyTree:
            context = self.prepare(case)
            return self.decode(self.guesses(context, 1)[0], context)

        return jax.eval_shape(jax.vmap(plan), cases)

    def changed(self, settings: Settings) -> Self:
        """The planner with some of its fields set anew; its plans keep their shape."""
        return dataclasses.replace(self, **dict(settings))  # type: ignore[type-var]

    def with_solver(self, solver: Solver = _LONG) -> Self:
        """The planner with one search from the first guess instead of its rounds, a long one."""
        return self.changed((("rounds", (Round(solver=solver),)),))

    def polished(self, solver: NewtonConfig | None = None) -> Self:
        """The planner whose first round goes on by Newton's method, to the optimum by default."""
        if solver is None:
            solver = self._suited(_POLISH)
        first, *others = self.rounds
        stages = (*first.stages, Stage(first.solver, first.settings))
        first = dataclasses.replace(first, solver=solver, stages=stages)
        return self.changed((("rounds", (first, *others)),))

    def with_effort(self, effort: str) -> Self:
        """The planner with another first round, which searches on after every limit holds.

        Args:
            effort: "good" for an iteration of Newton's method, "best" for 8, and more of the cases
                that still have something to gain: 2 % of the cost for "good", 1e-7 for "best".
                The rounds behind it, for what it leaves unsolved, stay as they are.
        """
        return self.polished(self._suited(_EFFORTS[effort]))

    def _suited(self, solver: NewtonConfig) -> NewtonConfig:
        """With as many vectors as the planner's preconditioner leaves to be searched."""
        return dataclasses.replace(solver, subspace=self.subspace)
