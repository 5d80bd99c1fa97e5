"""The base class of every planner: what `plan`, `solve`, `replan` and `gradient` may call.

A planner is a pytree: sizes and switches are static, arrays such as a library of motions or the
weights of a network are leaves, so that other arrays of the same shapes compile nothing anew. A
frozen dataclass of sizes and switches alone becomes a pytree by `jax.tree_util.register_static`.
"""

import enum
import functools
from collections.abc import Callable, Sequence
from typing import ClassVar, Generic, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend.backend import backends
from jaxtyping import PyTree

from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.protocol import Attempt, Plan
from planner_jax.core.rules import Case

CaseT = TypeVar("CaseT", bound=Case)
PlanT = TypeVar("PlanT", bound=Plan)


class Kind(enum.Enum):
    """How a planner makes its plans."""

    COMPILED = "compiled"  # `solve`, a pure function of one case
    HOST = "host"  # `solve_on_host`, of a batch of NumPy arrays
    COMPOSITE = "composite"  # `plan_by`, with plans of other planners


class Drive(Protocol):
    """Has planners plan, for the `plan_by` of a composite planner."""

    @property
    def is_pure(self) -> bool:
        """Whether this happens inside a compiled program, where arrays have no values yet."""
        ...

    @property
    def is_over(self) -> bool:
        """Whether the caller's time has passed, so that no further attempt may start."""
        ...

    def __call__(
        self, planner: "Planner", cases: PyTree, attempts: Sequence[Attempt] | None = None
    ) -> tuple[PyTree, PyTree]:
        """Return plans of a batch by some of a planner's attempts, by default all of them.

        Returns:
            The plans, and numbers that are all zero if no case is unsolved.
        """
        ...

    def plan_again(
        self, plan_of: Callable[[PyTree], PyTree], cases: PyTree, plans: PyTree, left: PyTree
    ) -> PyTree:
        """Return plans (B,) after one more try at the cases that are left, with the better plans.

        Args:
            plan_of: makes plans of a batch of the cases.
            cases: (B,).
            plans: of the cases; those with NumPy leaves are changed in place.
            left: (B,) bool. When the caller's time has passed, they are not tried again.
        """
        ...


class Planner(Generic[CaseT, PlanT]):
    """A planner of one class of cases.

    A subclass implements one of `solve`, `solve_on_host` and `plan_by`, which settles its `kind`,
    and whatever else it can do. Abilities that it leaves out raise a one-line error.
    """

    kind: ClassVar[Kind | None] = None
    case_type: ClassVar[type] = Case  # cases of other classes are rejected
    plan_type: ClassVar[type[Plan]] = Plan  # of the plans that `begin` takes
    # Whether a CPU solves a batch case after case. It should where one case may take many times as
    # long as another: in step, all cases would wait for the slowest one.
    is_sequential: ClassVar[bool] = False

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if cls.plan_by is not Planner.plan_by:
            cls.kind = Kind.COMPOSITE
        elif cls.solve_on_host is not Planner.solve_on_host:
            cls.kind = Kind.HOST
        elif cls.solve is not Planner.solve:
            cls.kind = Kind.COMPILED

    @property
    def attempts(self) -> Sequence[Attempt]:
        """The attempts, in order; each is made at the cases that are still unsolved."""
        return (Attempt(),)

    @property
    def inner(self) -> "Planner":
        """The planner that a planner around another one calls; otherwise the planner itself."""
        return self

    def solve(self, case: CaseT, attempt: PyTree, /) -> PlanT:
        """Return the plan that one attempt makes of one case; pure."""
        raise NotImplementedError

    def solve_lanes(self, cases: CaseT, attempt: PyTree, /) -> PlanT:
        """Return the plans that one attempt makes of a batch; pure."""
        if not self.is_sequential:
            return self.solve_at_once(cases, attempt)
        in_turn = functools.partial(solve_in_turn, lambda case: self.solve(case, attempt))
        if has_only_cpu():  # the program of other devices is not even traced, which takes longer
            return in_turn(cases)
        return lax.platform_dependent(
            cases, cpu=in_turn, default=lambda cases: self.solve_at_once(cases, attempt)
        )

    def solve_at_once(self, cases: CaseT, attempt: PyTree, /) -> PlanT:
        """Return the plans that one attempt makes of a batch, all cases in step; pure."""
        return jax.vmap(lambda case: self.solve(case, attempt))(cases)

    def solve_on_host(self, cases: CaseT, attempt: PyTree, /) -> PlanT:
        """Return the plans that one attempt makes of a batch; NumPy leaves in and out."""
        raise NotImplementedError

    def plan_by(self, drive: Drive, cases: CaseT, /) -> PlanT:
        """Return the plans of a batch, made of plans of other planners by `drive`."""
        raise NotImplementedError

    def starts_long(self, cases: CaseT) -> bool:
        """Return whether the first attempt at such cases is already a long search."""
        return False

    def replanner(self) -> "Planner":
        """Return the planner that continues from plans of this one; see `pj.replan`."""
        return self

    def begin(self, *args: PyTree, **news: PyTree) -> Case:
        """Return what is left of cases some time into their plans; see `pj.replan`.

        A re-planner takes the cases, the previous plans, the time since these began, and by name
        what has changed.

        Raises:
            TypeError: the planner is no re-planner.
        """
        raise TypeError(
            f"{type(self).__name__} cannot plan again: use hits' and catches' exact, intercepts' "
            "spacetime, or ReplanBlock"
        )

    def settle(
        self, cases: CaseT, plan_of: Callable[["Planner", PyTree], PyTree] | None = None
    ) -> "tuple[PyTree, PyTree]":
        """Return an `OptimisedPlanner`, and the cases with all that is decided before it starts.

        Args:
            cases: one case, or a batch.
            plan_of: plans cases by a planner. By default the first decision and the first search
                count, which is pure, and constant to derivatives.

        Raises:
            TypeError: the planner minimises nothing.
        """
        raise TypeError(
            f"{type(self).__name__} minimises nothing, so that its plans have no gradient: use "
            "a planner that does, such as hits' and catches' exact or intercepts' spacetime"
        )

    def with_effort(self, effort: str) -> "Planner":
        """Return the planner with a longer search; see `planner_jax.core.choices`.

        Raises:
            ValueError: the planner minimises nothing.
        """
        rule = f"feasible for a {type(self).__name__}, which minimises nothing"
        raise ArgumentError("effort", rule, effort)


def require_planner(planner: object) -> None:
    """Raise `TypeError` unless the argument `planner` is a planner."""
    if not isinstance(planner, Planner) or planner.kind is None:
        is_class = isinstance(planner, type)
        got = f"the class {planner.__name__}" if is_class else f"a {type(planner).__name__}"
        raise ArgumentTypeError("planner", "one, such as pj.hit.planner()", got)


def require_fit(planner: Planner, cases: object) -> None:
    """Raise unless the planner is one, a pytree with an attempt, and the cases are of its class.

    Raises:
        TypeError: it is none, or the cases are of another class.
        ValueError: it has no attempt.
    """
    require_planner(planner)
    if jax.tree_util.all_leaves([planner]) and planner.kind is not Kind.HOST:
        rule = "a pytree: put @jax.tree_util.register_static over its frozen dataclass, or make it "
        rule += "a flax.struct.dataclass if it holds arrays"
        raise ArgumentTypeError(type(planner).__name__, rule, shown="")
    if not isinstance(cases, planner.case_type):
        raise TypeError(
            f"{type(planner).__name__} plans cases of the class {planner.case_type.__name__}, got "
            f"{type(cases).__name__}"
        )
    if not planner.attempts:
        raise ArgumentError(
            type(planner).__name__, "at least one attempt", verb="have", shown="none"
        )


def has_only_cpu() -> bool:
    """Return whether all devices that JAX has are CPUs."""
    return set(backends()) == {"cpu"}


def solve_in_turn(solve: Callable[[PyTree], PyTree], cases: PyTree) -> PyTree:
    """Return what a function makes of every case of a batch, one after another; pure.

    A case that equals the one before, such as those that fill up a batch, is not solved again.
    """
    first = jax.tree.map(lambda leaf: leaf[0], cases)
    nothing = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(solve, first)
    )

    def next_one(state: tuple[Array, PyTree, PyTree], case: PyTree) -> tuple[tuple, PyTree]:
        is_first, before, plan = state
        same = jax.tree.map(lambda a, b: jnp.array_equal(a, b), before, case)
        is_again = jnp.all(jnp.stack(jax.tree.leaves(same))) & ~is_first
        plan = lax.cond(is_again, lambda case: plan, solve, case)
        return (jnp.zeros_like(is_first), case, plan), plan

    _, plans = lax.scan(next_one, (jnp.ones((), bool), first, nothing), cases)
    return plans
