"""The base class of planners that minimise a cost, with the methods that subclasses define."""

import abc
import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.arithmetic import float_type
from planner_jax.core.checks import require_numeric
from planner_jax.core.choices import EFFORTS, require_one_of
from planner_jax.core.planner import CaseT, Planner, PlanT
from planner_jax.core.protocol import Score
from planner_jax.optimise.rows import Group, Table, group_rounds, load_group
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

# Settings with which Newton's method continues the first round (attempt) to the optimum.
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
# Value of `effort` -> settings of Newton's method, which continues the first round (attempt).
_EFFORTS = {
    "good": NewtonConfig(max_steps=1, damping=1e-6, tolerance=2e-2, stragglers=(0.125, 2, 60)),
    "best": NewtonConfig(
        max_steps=8, damping=1e-6, tolerance=1e-7, patience=8, stragglers=(0.125, 8, 32)
    ),
}


def pending(violation: Array) -> dict[str, PyTree]:
    """Return the fields of a new `Plan`: its violation, and zeros that the solver overwrites."""
    zero = jnp.zeros((), jnp.int32)
    return {
        "cost": jnp.zeros_like(require_numeric("violation", violation)),
        "violation": violation,
        "iterations": zero,
        "status": zero,
    }


class OptimisedPlanner(Planner[CaseT, PlanT], abc.ABC):
    """Base class of planners that minimise by L-BFGS or Newton's method, in rounds.

    A round is one attempt at the cases that earlier rounds left unsolved. A subclass is a frozen
    dataclass and a pytree (`jax.tree_util.register_static` if it holds no arrays) with a field
    `rounds`. Its functions `prepare`, `guesses`, `objective` and `decode` are pure and take one
    case. Their decision variables are scaled, so that second derivatives are of order one.
    """

    rounds: tuple[Round, ...]  # attempts, in order
    # Fields with numbers of the cost, which compiled programs read at run time. They do not change
    # `prepare`, `guesses` and `decode`. The `settings` of rounds may change them.
    weights: ClassVar[tuple[str, ...]] = ()
    # Fields that the `settings` of rounds may change to refine plans. A plan of a coarse planner is
    # one of a fine planner, whose additional variables, `held`, are zero.
    refinements: ClassVar[tuple[str, ...]] = ()
    # Number of Newton's subspace vectors. With 0 the preconditioner counts as inverse Hessian.
    subspace: ClassVar[int] = 4
    # Default of `curvature` in `pj.gradient`: "products" with the Hessian, or the "whole" Hessian.
    adjoint: ClassVar[str] = "products"

    @abc.abstractmethod
    def prepare(self, case: PyTree) -> PyTree:
        """Return data that all evaluations of a case share, such as a table of the ball's path."""

    @abc.abstractmethod
    def guesses(self, context: PyTree, num: int) -> Array:
        """Return the first `num` starting points in n variables, (num, n), best first."""

    @abc.abstractmethod
    def objective(self, point: Array, context: PyTree) -> Evaluation:
        """Return the cost and the largest violation of a limit at a point (n,)."""

    def curvature_at(self, point: Array, context: PyTree) -> Curvature:
        """Return gradient, products with the Hessian, and preconditioner at a point (n,).

        By default automatic differentiation of the gradient computes each product with the Hessian,
        and there is no preconditioner.
        """
        from planner_jax.optimise.newton import by_products  # only planners that polish need it

        return by_products(lambda x: self.objective(x, context))(point)

    @abc.abstractmethod
    def decode(self, point: Array, context: PyTree) -> PyTree:
        """Return the plan at a point (n,), with a more exact violation than in `objective`.

        The solver sets the plan's `cost`, `iterations` and `status` afterwards.
        """

    def rules_out(self, context: PyTree) -> Array:
        """Return whether it is proven that the case has no plan, () bool; false by default.

        Such a case, if unsolved, has the status `TOO_FAR`, and no further search is made.
        """
        return jnp.zeros((), bool)

    @property
    def held(self) -> np.ndarray | None:
        """Mask (n,) of variables that searches with `Stage.frozen` keep constant; None if none."""
        return None

    @property
    def size(self) -> int:
        """A number that grows with the number of variables, for planners with `refinements`."""
        return 0

    def network_inputs(self, context: PyTree) -> Array:
        """Return the features (F,) of a case for its network; none without a network."""
        return jnp.zeros((0,))

    def first_start(self, guess: Array, features: Array, context: PyTree) -> Array:
        """Return the first starting point (n,): by default the guess itself."""
        return guess

    def first_guess(self, context: PyTree) -> Array:
        """Return the point (n,) from which the first search of a case starts."""
        guess = self.guesses(context, 1)[0]
        return self.first_start(guess, self.network_inputs(context), context)

    @property
    def attempts(self) -> tuple[Round, ...]:
        """The planner's rounds: attempts at a case, in order, until one attempt solves it."""
        return self.rounds

    def fit_attempt(self, attempt: Round, cases: PyTree) -> Round:
        """Return a round (attempt) with settings for these cases, by default unchanged.

        The method may use only the class and the shapes of the cases.
        """
        return attempt

    def group_attempts(
        self, attempts: Sequence[Round], cases: PyTree, *, is_whole: bool
    ) -> list[Group]:
        """Join rounds (attempts) that share a compiled program."""
        known, places = tuple(self.attempts), tuple(range(len(attempts)))
        if attempts is not known and tuple(attempts) != known:
            places = tuple(known.index(each) if each in known else -1 for each in attempts)
            if -1 in places:  # rounds that the planner does not have
                known, places = tuple(attempts), tuple(range(len(attempts)))
        fitted = tuple([self.fit_attempt(each, cases) for each in known])
        return group_rounds(self, fitted, places, is_whole)

    def load(self, attempt: Round | Group, cases: PyTree) -> tuple[PyTree, Table]:
        """Return arguments of compiled programs for a round, or a group of rounds (attempts)."""
        if isinstance(attempt, Round):
            attempt = Group.of((self.fit_attempt(attempt, cases),), (0,))
        return load_group(self, attempt)

    def solve(self, case: PyTree, attempt: Round | Table, before: Score | None = None) -> PyTree:
        """Return the plan that rounds (attempts) find for one case; see `solve_lanes`."""
        cases, before = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (case, before))
        return jax.tree.map(lambda leaf: leaf[0], self.solve_lanes(cases, attempt, before))

    def solve_lanes(
        self, cases: PyTree, attempt: Round | Table, before: Score | None = None
    ) -> PyTree:
        """Return the plans that rounds (attempts) find for a batch of cases.

        `before` are the numbers of earlier plans; only better plans are returned, see
        `search.solve_table`. None: there are no earlier plans.
        """
        from planner_jax.optimise.search import solve_table  # reads this class

        cases = jax.tree.map(jnp.asarray, cases)
        table = self.load(attempt, cases)[1] if isinstance(attempt, Round) else attempt
        if before is None:
            before = Score.none(cases.batch_shape, float_type(cases))
        return solve_table(self, table, cases, jax.tree.map(jnp.asarray, before))

    def settle(
        self, cases: PyTree, plan_of: Callable[[Planner, PyTree], PyTree] | None = None
    ) -> tuple[Self, PyTree]:
        """Return the planner and the cases unchanged: there is no choice, such as an order, to fix.

        `plan_of(planner, cases)`, which would make plans to choose from, is not called.
        """
        return self, cases

    def with_settings(self, settings: Settings) -> Self:
        """Return a copy of the planner with the field values in `settings`, pairs (name, value)."""
        return dataclasses.replace(self, **dict(settings))  # type: ignore[type-var]

    def setting(self, name: str) -> PyTree:
        """Return the value of a field that `with_settings` changes."""
        return getattr(self, name)

    def with_weights(self, weights: dict[str, PyTree]) -> Self:
        """Return a copy of the planner with arrays in fields that are listed in `weights`."""
        planner = copy.copy(self)  # `dataclasses.replace` would check the arrays' values
        for name, value in weights.items():
            object.__setattr__(planner, name, value)
        return planner

    def with_solver(self, solver: Solver = _LONG) -> Self:
        """Return a copy of the planner that makes one long search from its best first guess."""
        return self.with_settings((("rounds", (Round(solver=solver),)),))

    def with_polish(self, solver: NewtonConfig | None = None) -> Self:
        """Return a copy of the planner whose first round (attempt) continues by Newton's method.

        `solver` has the settings of the method; None: settings that continue to a local optimum.
        """
        first, *others = self.rounds
        stages = (*first.stages, Stage(first.solver, first.settings))
        first = dataclasses.replace(
            first, solver=solver or self._fit_subspace(_POLISH), stages=stages
        )
        return self.with_settings((("rounds", (first, *others)),))

    def with_effort(self, effort: str) -> Self:
        """Return a copy of the planner that lowers the cost further after every limit holds.

        Only the first round (attempt) is longer. The later rounds are unchanged.

        Args:
            effort: "good" adds one iteration of Newton's method for each case, "best" adds up to 8.
                Further iterations follow for cases whose predicted relative decrease of the cost
                exceeds 2e-2 ("good") or 1e-7 ("best"). "feasible" returns the planner itself.
        """
        require_one_of(EFFORTS, "effort", effort)
        return (
            self.with_polish(self._fit_subspace(_EFFORTS[effort])) if effort in _EFFORTS else self
        )

    def _fit_subspace(self, solver: NewtonConfig) -> NewtonConfig:
        return dataclasses.replace(solver, subspace=self.subspace)
