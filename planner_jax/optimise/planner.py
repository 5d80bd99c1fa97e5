"""Planners that minimise a cost: a problem, stated by pure functions, and attempts to solve it."""

import abc
import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import ClassVar, Generic, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.arithmetic import float_type
from planner_jax.core.checks import require_numeric
from planner_jax.core.choices import EFFORTS, require_one_of
from planner_jax.core.planner import CaseT, Planner, PlanT
from planner_jax.core.protocol import Score, require_attempts
from planner_jax.core.rules import Case
from planner_jax.optimise.rows import Group, Table, join_attempts, load_group
from planner_jax.optimise.settings import (
    Attempt,
    Attempts,
    Curvature,
    Evaluation,
    NewtonConfig,
    Settings,
    Solver,
)


def pending(violation: Array) -> dict[str, PyTree]:
    """Return the fields of a new `Plan`: its violation, and zeros that the solver overwrites."""
    zero = jnp.zeros((), jnp.int32)
    return {
        "cost": jnp.zeros_like(require_numeric("violation", violation)),
        "violation": violation,
        "iterations": zero,
        "status": zero,
    }


class Problem(Generic[CaseT, PlanT], abc.ABC):
    """Base class of what a `SearchPlanner` minimises for one case.

    A subclass is a frozen dataclass and a pytree (`jax.tree_util.register_static` if it holds no
    arrays). Its functions `prepare`, `guesses`, `objective` and `decode` are pure and take one
    case. Their decision variables are scaled, so that second derivatives are of order one.
    """

    case_type: ClassVar[type] = Case  # cases of other classes are rejected
    attempts: ClassVar[Attempts] = (Attempt(),)  # usual attempts of planners, in order
    # Fields with numbers of the cost, which compiled programs read at run time. They do not change
    # `prepare`, `guesses` and `decode`. The `settings` of attempts may change them.
    weights: ClassVar[tuple[str, ...]] = ()
    # Fields that the `settings` of attempts may change to refine plans. A plan of a coarse planner
    # is one of a fine planner, whose additional variables, `held`, are zero.
    refinements: ClassVar[tuple[str, ...]] = ()
    subspace: ClassVar[int] = 4  # Newton's vectors; 0: the preconditioner is the inverse Hessian
    guesses_minima: ClassVar[bool] = False  # whether Newton's method need not continue from them
    # Default of `curvature` in `pj.gradient`: "products" with the Hessian, or the "whole" Hessian.
    adjoint: ClassVar[str] = "products"
    needs_double: ClassVar[bool] = False  # whether `pj.gradient` computes in float64

    @abc.abstractmethod
    def prepare(self, case: PyTree) -> PyTree:
        """Return data that all evaluations of a case share, such as a table of the ball's path."""

    @abc.abstractmethod
    def guesses(self, context: PyTree, num: int) -> Array:
        """Return the first `num` starting points in n variables, (num, n), best first."""

    @abc.abstractmethod
    def objective(self, point: Array, context: PyTree) -> tuple[Array, Array]:
        """Return the cost and the largest violation of a limit at a point (n,), two arrays ()."""

    def slopes_along(self, x: Array, context_of: Callable, parts: PyTree, along: Array) -> PyTree:
        """Return the gradient, by parts of the context, of the slope at `x` (n,) along a vector."""
        slopes = jax.grad(lambda parts, x: self.objective(x, context_of(parts))[0])
        return jax.jvp(lambda x: slopes(parts, x), (x,), (along,))[1]

    def curvature_at(self, point: Array, context: PyTree) -> Curvature:
        """Return gradient, products with the Hessian, and preconditioner at a point (n,).

        By default automatic differentiation of the gradient computes each product with the Hessian,
        and there is no preconditioner.
        """
        from planner_jax.optimise.newton import by_products  # only planners that polish need it

        return by_products(lambda x: Evaluation(*self.objective(x, context)))(point)

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

    def fit_attempt(
        self, attempt: Attempt, cases: PyTree, attempts: tuple[Attempt, ...]
    ) -> Attempt:
        """Return one of a planner's `attempts` with settings for the shapes of these cases."""
        return attempt

    def starts_long(self, cases: PyTree, attempts: Attempts) -> bool:
        """Return whether the first of a planner's `attempts` takes long."""
        return False

    def replanner(self) -> "SearchPlanner | None":
        """Return the planner by which `pj.replan` updates plans, if it is another one."""
        return None

    def with_settings(self, settings: Settings) -> Self:
        """Return a copy with the field values in `settings`, pairs (name, value)."""
        return dataclasses.replace(self, **dict(settings))  # type: ignore[type-var]

    def setting(self, name: str) -> PyTree:
        """Return the value of a field that `with_settings` changes."""
        return getattr(self, name)

    def with_weights(self, weights: dict[str, PyTree]) -> Self:
        """Return a copy with arrays in fields that are listed in `weights`."""
        problem = copy.copy(self)  # `dataclasses.replace` would check the arrays' values
        for name, value in weights.items():
            object.__setattr__(problem, name, value)
        return problem

    def with_usual(self, names: Sequence[str]) -> Self:
        """Return a copy with the default values of these fields of its class."""
        usual = [(name, getattr(type(self), name, None)) for name in names]
        return self.with_settings(tuple(pair for pair in usual if pair[1] is not None))

    @classmethod
    def planner(
        cls, attempts: tuple[Attempt, ...] | None = None, **numbers: object
    ) -> "SearchPlanner":
        """Make a planner of the problem with these `attempts` and values of its fields."""
        return SearchPlanner(cls(**numbers), attempts)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class SearchPlanner(Planner[CaseT, PlanT]):
    """A planner that minimises, in attempts at the cases that are still unsolved.

    Attributes:
        problem: the `Problem` to minimise.
        attempts: attempts (searches) in their order; by default the usual ones of the problem.
    """

    problem: PyTree
    attempts: PyTree = dataclasses.field(default=None, metadata={"static": True})

    def __post_init__(self) -> None:
        if self.attempts is None:
            object.__setattr__(self, "attempts", self.problem.attempts)
        require_attempts("attempts", self.attempts, Attempt)

    @property
    def title(self) -> str:
        """Name of the problem, for messages."""
        return type(self.problem).__name__

    @property
    def case_type(self) -> type:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The class of the planner's cases."""
        return self.problem.case_type

    def replanner(self) -> "SearchPlanner":
        """Return the planner by which `pj.replan` updates plans in flight."""
        return self.problem.replanner() or self

    def starts_long(self, cases: CaseT) -> bool:
        """Return whether the first attempt (search) for these cases takes long."""
        return self.problem.starts_long(cases, self.attempts)

    def group_attempts(
        self, attempts: Sequence[Attempt], cases: PyTree, *, is_whole: bool
    ) -> list[Group]:
        """Join attempts that share a compiled program."""
        known, places = tuple(self.attempts), tuple(range(len(attempts)))
        if attempts is not known and tuple(attempts) != known:
            places = tuple(known.index(each) if each in known else -1 for each in attempts)
            if -1 in places:  # attempts that the planner does not have
                known, places = tuple(attempts), tuple(range(len(attempts)))
        fitted = tuple([self.problem.fit_attempt(each, cases, self.attempts) for each in known])
        return join_attempts(self.problem, fitted, places, is_whole)

    def load(self, attempt: Attempt | Group, cases: PyTree) -> tuple[PyTree, Table]:
        """Return arguments of compiled programs for an attempt, or a group of attempts."""
        if isinstance(attempt, Attempt):
            attempt = Group.of((self.problem.fit_attempt(attempt, cases, self.attempts),), (0,))
        return load_group(self.problem, attempt)

    def solve(self, case: PyTree, attempt: Attempt | Table, before: Score | None = None) -> PyTree:
        """Return the plan that an attempt, or a table of them, finds for one case."""
        cases, before = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (case, before))
        return jax.tree.map(lambda leaf: leaf[0], self.solve_lanes(cases, attempt, before))

    def solve_lanes(
        self, cases: PyTree, attempt: Attempt | Table, before: Score | None = None
    ) -> PyTree:
        """Return the plans that an attempt, or a table of attempts, finds for a batch of cases.

        `before` are the numbers of earlier plans; only better plans are returned, see
        `search.solve_table`. None: there are no earlier plans.
        """
        from planner_jax.optimise.search import solve_table  # reads the class of problems

        cases = jax.tree.map(jnp.asarray, cases)
        table = self.load(attempt, cases)[1] if isinstance(attempt, Attempt) else attempt
        before = Score.none(cases.batch_shape, float_type(cases)) if before is None else before
        return solve_table(self.problem, table, cases, jax.tree.map(jnp.asarray, before))

    def settle(
        self, cases: PyTree, plan_of: Callable[[Planner, PyTree], PyTree] | None = None
    ) -> tuple[Self, PyTree]:
        """Return the planner and the cases unchanged, as there is no choice to fix."""
        return self, cases

    def with_settings(self, settings: Settings) -> Self:
        """Return a copy with the values in `settings`, pairs (name, value).

        The names are `attempts` and fields of the problem.
        """
        values = dict(settings)
        attempts: PyTree = values.pop("attempts", self.attempts)
        problem = self.problem.with_settings(tuple(values.items())) if values else self.problem
        return dataclasses.replace(self, problem=problem, attempts=attempts)

    def with_solver(self, solver: Solver | None = None) -> Self:
        """Return a copy that makes one search from its best first guess, by default a long one."""
        from planner_jax.optimise.efforts import LONG  # usual searches are shorter

        return dataclasses.replace(self, attempts=(Attempt(solver=solver or LONG),))

    def with_polish(self, solver: NewtonConfig | None = None) -> Self:
        """Return a copy of the planner whose first attempt continues by Newton's method.

        `solver` has the settings of the method; None: settings that continue to a local optimum.
        """
        from planner_jax.optimise.efforts import polish

        return polish(self, solver)

    def with_effort(self, effort: str) -> Self:
        """Return a copy whose first attempt lowers the cost further when limits hold.

        Args:
            effort: "good" adds one iteration of Newton's method for each case, "best" adds up to 8.
                Further iterations follow for cases whose predicted relative decrease of the cost
                exceeds 2e-2 ("good") or 1e-7 ("best"). "feasible" returns the planner itself.
        """
        require_one_of(EFFORTS, "effort", effort)
        if effort == EFFORTS[0]:
            return self
        from planner_jax.optimise.efforts import polish

        return polish(self, effort)
