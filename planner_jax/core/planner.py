"""The base class of every planner, with the methods that `plan`, `replan` and `gradient` call.

A planner is a pytree. Sizes and switches are static. Arrays, such as a library of motions or the
weights of a network, are leaves, so that other arrays of the same shapes need no compilation. A
frozen dataclass without arrays becomes a pytree by `jax.tree_util.register_static`.
"""

import enum
import functools
from collections.abc import Callable, Sequence
from typing import ClassVar, Generic, Protocol, Self, TypeVar

import jax
from jax import lax
from jaxtyping import PyTree

from planner_jax.core.choices import EFFORTS, require_one_of
from planner_jax.core.compiled import Fixed, has_only_cpu, traced_platform
from planner_jax.core.errors import ArgumentError, ArgumentTypeError, NotOffered
from planner_jax.core.protocol import BaseAttempt, Plan
from planner_jax.core.rules import Case

CaseT = TypeVar("CaseT", bound=Case)
PlanT = TypeVar("PlanT", bound=Plan)


class Kind(enum.Enum):
    """Name the method by which a planner makes plans; a planner implements one of the three."""

    COMPILED = "compiled"  # `solve`, a pure function of one case
    HOST = "host"  # `solve_on_host`, a function of a batch of NumPy arrays
    COMPOSITE = "composite"  # `plan_by`, which calls other planners


class Drive(Protocol):
    """Function with which the method `plan_by` of a composite planner calls other planners."""

    @property
    def is_pure(self) -> bool:
        """True inside a compiled program, where arrays have no values yet."""
        ...

    @property
    def is_over(self) -> bool:
        """True if the caller's time limit has passed, after which no search may start."""
        ...

    def __call__(
        self, planner: "Planner", cases: PyTree, attempts: Sequence[BaseAttempt] | None = None
    ) -> tuple[PyTree, PyTree]:
        """Plan a batch by the listed attempts (searches) of a planner, by default by all of them.

        Returns:
            The plans, and a bool array, true for unsolved cases; or, for a batch outside of
            compiled programs, the number of unsolved cases.
        """
        ...

    def plan_again(
        self, plan_of: Callable[[PyTree], PyTree], cases: PyTree, plans: PyTree, left: PyTree
    ) -> PyTree:
        """Plan some of B cases again; return the better of the old and new plan of each case.

        `plan_of` makes plans of a batch of cases. The cases where `left` (B,) is true are planned,
        unless the caller's time limit has passed. NumPy arrays in `plans` are changed in place.
        """
        ...


class Planner(Generic[CaseT, PlanT]):
    """A planner of one class of cases.

    A subclass implements one of the methods of `Kind`: `solve`, `solve_on_host` or `plan_by`. The
    other methods are optional; methods without a default raise an error.
    """

    kind: ClassVar[Kind | None] = None
    case_type: ClassVar[type] = Case  # cases of other classes are rejected
    plan_type: ClassVar[type[Plan]] = Plan  # class of the previous plans that `begin` accepts
    # Whether a CPU solves the cases of a batch one after another. This suits planners whose cases
    # differ much in computing time: solved together, all cases would wait for the slowest one.
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
    def attempts(self) -> Sequence[BaseAttempt]:
        """The attempts (settings of a search), in order; each is for cases still unsolved."""
        return (BaseAttempt(),)

    def attempts_for(self, cases: CaseT) -> Sequence[BaseAttempt]:
        """Return the attempts useful for cases, which may be traced; by default all `attempts`."""
        return self.attempts

    def fit_shapes(self, cases: CaseT, /) -> CaseT:
        """Return cases with the same plans, in arrays of few shapes; by default the cases."""
        return cases

    def load_attempt(self, attempt: PyTree, cases: CaseT, /) -> PyTree:
        """Convert an attempt (settings of a search) to the second argument of the compiled `solve`.

        By default each attempt is static, and compiles a program of its own. Attempts that are
        pytrees of the same structure share one program; see the module `core.compiled`. The method
        may use only the class and the shapes of the cases.
        """
        return Fixed(attempt)

    def load(self, attempt: PyTree, cases: CaseT, /) -> tuple[PyTree, PyTree]:
        """Return the first and second argument of the compiled `solve`: planner and attempt."""
        return self, self.load_attempt(attempt, cases)

    def group_attempts(
        self, attempts: Sequence[PyTree], cases: CaseT, /, *, is_whole: bool
    ) -> Sequence[PyTree]:
        """Return the attempts (searches) in the form in which compiled programs make them.

        By default they are unchanged. A planner may join attempts that one program makes in turn,
        for `pj.solve`, which `is_whole` means.
        """
        return attempts

    def compiles_quickly(self, attempt: PyTree, /) -> bool:
        """Return whether a CPU compiles the search of an attempt for one case by `QUICK_OPTIONS`.

        These options of XLA save compile time, but the program may run slower. By default planners
        use them unless a CPU solves the cases of their batches one by one (`is_sequential`).
        """
        return not self.is_sequential

    @property
    def title(self) -> str:
        """Name of the planner in messages."""
        return type(self).__name__

    @property
    def inner(self) -> "Planner":
        """The planner inside a planner that wraps another one; otherwise the planner itself."""
        return self

    def solve(self, case: CaseT, attempt: PyTree, /) -> PlanT:
        """Return the plan of one case by the search that `attempt` specifies; pure."""
        raise NotImplementedError

    def solve_lanes(self, cases: CaseT, attempt: PyTree, /) -> PlanT:
        """Return a batch's plans by one attempt (search), one by one on CPUs if `is_sequential`."""
        if not self.is_sequential:
            return self.solve_at_once(cases, attempt)
        from planner_jax.core.in_turn import solve_in_turn  # few planners need it

        in_turn = functools.partial(solve_in_turn, lambda case: self.solve(case, attempt))
        at_once = lambda cases: self.solve_at_once(cases, attempt)  # noqa: E731
        platform = "cpu" if has_only_cpu() else traced_platform()
        if platform is None:
            return lax.platform_dependent(cases, cpu=in_turn, default=at_once)
        return in_turn(cases) if platform == "cpu" else at_once(cases)

    def solve_at_once(self, cases: CaseT, attempt: PyTree, /) -> PlanT:
        """Return the plans of a batch by one attempt (search), by default with `jax.vmap`; pure."""
        return jax.vmap(lambda case: self.solve(case, attempt))(cases)

    def solve_on_host(self, cases: CaseT, attempt: PyTree, /) -> PlanT:
        """Return a batch's plans by one attempt (search); cases and plans are in NumPy arrays."""
        raise NotImplementedError

    def plan_by(self, drive: Drive, cases: CaseT, /) -> PlanT:
        """Compose the plans of a batch from plans of other planners, which `drive` calls."""
        raise NotImplementedError

    def starts_long(self, cases: CaseT) -> bool:
        """Return whether the first attempt (search) for these cases takes long.

        A planner that tries several choices for a case, such as orders of targets, then makes later
        attempts only if no choice has solved the case.
        """
        return False

    def replanner(self) -> "Planner":
        """Return the planner that `pj.replan` uses to continue from existing plans."""
        return self

    def begin(self, *args: PyTree, **news: PyTree) -> Case:
        """Return what remains to be planned of cases whose plans are being executed.

        The returned cases start at the robot's present state, contain the changed quantities and
        the previous plans, and leave out what is already done, such as targets caught. The method
        takes the arguments of `pj.replan`: the original cases, the previous plans, the time since
        the plans started, and changed quantities by name.

        Raises:
            TypeError: the planner cannot continue from existing plans.
        """
        raise NotOffered(
            f"{self.title} cannot plan again: use hits' and catches' exact, intercepts' "
            "spacetime, or blocks' online"
        )

    def settle(
        self, cases: CaseT, plan_of: Callable[["Planner", PyTree], PyTree] | None = None
    ) -> "tuple[PyTree, PyTree]":
        """Return a planner that minimises a cost, and the cases with all open decisions taken.

        An open decision is, for example, the order of targets. `plan_of(planner, cases)` makes
        plans, from which the decisions are taken. Without it the planner's first proposals are
        taken, or `plan_once` makes the plans; the method is then pure. Derivatives treat decisions
        as constants.

        Raises:
            TypeError: the planner does not minimise a cost.
        """
        smooth = self.smooth()
        once = lambda _, cases: self.plan_once(lax.stop_gradient(cases))  # noqa: E731
        return smooth.near(cases, (plan_of or once)(self, cases))

    def plan_once(self, cases: CaseT) -> PyTree:
        """Return the plans from which `settle` starts, by default of the first attempt; pure."""
        return self.solve(cases, self.attempts[0])

    def smooth(self) -> PyTree:
        """Return the problem, with a method `near`, whose minima are near this planner's plans.

        Raises:
            TypeError: the planner does not minimise a cost.
        """
        raise NotOffered(
            f"{type(self).__name__} minimises nothing, so that its plans have no gradient: use "
            "a planner that does, such as blocks' online or hits' exact"
        )

    def with_effort(self, effort: str) -> Self:
        """Return a copy of the planner that continues to lower the cost when every limit holds.

        The effort "good" allows a short and "best" a long further search. The effort "feasible"
        returns the planner itself, which stops at a case as soon as every limit holds.

        Raises:
            ArgumentError: the effort is unknown, or the planner does not minimise a cost.
        """
        require_one_of(EFFORTS, "effort", effort)
        if effort != EFFORTS[0]:
            rule = f"feasible for a {type(self).__name__}, which minimises nothing"
            raise ArgumentError("effort", rule, effort)
        return self


def require_planner(planner: object) -> None:
    """Raise `TypeError` unless the argument `planner` is an instance of a planner class."""
    if not isinstance(planner, Planner) or planner.kind is None:
        is_class = isinstance(planner, type)
        got = f"the class {planner.__name__}" if is_class else f"a {type(planner).__name__}"
        raise ArgumentTypeError("planner", "one, such as pj.hit.planner()", got)


def require_fit(planner: Planner, cases: object) -> None:
    """Raise unless `planner` is a pytree with an attempt (search), and for the class of `cases`."""
    require_planner(planner)
    if jax.tree_util.all_leaves([planner]) and planner.kind is not Kind.HOST:
        rule = "a pytree: put @jax.tree_util.register_static over its frozen dataclass, or make it "
        rule += "a flax.struct.dataclass if it holds arrays"
        raise ArgumentTypeError(type(planner).__name__, rule, shown="")
    if not isinstance(cases, planner.case_type):
        rule = f"of the class {planner.case_type.__name__}, which {planner.title} plans"
        raise ArgumentTypeError("cases", rule, shown=f"a {type(cases).__name__}")
    if not planner.attempts:
        raise ArgumentError(
            type(planner).__name__, "at least one attempt", verb="have", shown="none"
        )
