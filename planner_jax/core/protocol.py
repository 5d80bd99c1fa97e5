"""Plans, the rule that selects one of them, and attempts and decisions of planners."""

import dataclasses
import enum
import os
from collections.abc import Callable
from typing import Protocol, Self, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.arithmetic import Numbers, numpy_of
from planner_jax.core.checks import numeric, require_kind, require_number, require_switch
from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.rules import (
    NOT_NEGATIVE,
    POSITIVE,
    fields_of,
    has_rules,
    is_sound,
)


class Status(enum.IntEnum):
    """Outcome of one case; `message` explains it and names a remedy."""

    CONVERGED = 0
    FEASIBLE = 1
    INFEASIBLE = 2
    MAX_STEPS = 3
    NON_FINITE = 4
    OUT_OF_REACH = 5
    NO_PATH = 6
    BLOCKED = 7
    BAD_INPUT = 8
    TOO_FAR = 9
    OUT_OF_TIME = 10

    @property
    def message(self) -> str:
        """A sentence for the user, with the remedy."""
        return _MESSAGES[self]

    @classmethod
    def _missing_(cls, value: object) -> "Status | None":
        """Return the status in a jax array of one number, which cannot be a key of the lookup."""
        return next((status for status in cls if status == value), None)


_MESSAGES = {
    Status.CONVERGED: "stationary, and every limit holds",
    Status.FEASIBLE: "every limit holds; more iterations may lower the cost",
    Status.INFEASIBLE: "stationary with a limit exceeded; try more starts, or relax the limit",
    Status.MAX_STEPS: "out of iterations with a limit exceeded; allow more iterations or starts",
    Status.NON_FINITE: "the cost of the plan is not finite; bring the case's numbers nearer to one",
    Status.OUT_OF_REACH: "a target never comes within reach; `closest_approach` says by how much",
    Status.NO_PATH: "no way was found through the obstacles in time; allow more time",
    Status.BLOCKED: "the start or the goal lies in an obstacle or off the map; move it",
    Status.BAD_INPUT: "a number of the case is absurd; `pj.require_sound(cases)` names it",
    Status.TOO_FAR: "no plan exists: at no time is a target where the robot can be by then; allow "
    "more speed or acceleration, or start nearer",
    Status.OUT_OF_TIME: "a limit is exceeded, and `time_limit` ended the search; allow more time",
}


def is_solved(status: Numbers | int) -> Array:
    """Return which statuses belong to plans that keep every limit of their planner, bool."""
    return (status == Status.CONVERGED) | (status == Status.FEASIBLE)  # type: ignore[return-value]


def is_unsolved(status: Numbers | int) -> Array:
    """Return which statuses are worth another attempt: not solved, not broken, not hopeless."""
    worth = (status == Status.INFEASIBLE) | (status == Status.MAX_STEPS)
    return worth | (status == Status.OUT_OF_REACH)  # type: ignore[return-value]


# Plans are refereed to 1e-3 of a limit; half of that is left for peaks between samples.
FEASIBILITY_TOLERANCE = 5e-4


def status_of(cost: Array, violation: Array, stationary: Array | bool) -> Array:
    """Return the `Status` of a finished case, () int32."""
    feasible = violation <= FEASIBILITY_TOLERANCE
    status = jnp.where(
        feasible,
        jnp.where(stationary, Status.CONVERGED, Status.FEASIBLE),
        jnp.where(stationary, Status.INFEASIBLE, Status.MAX_STEPS),
    )
    finite = jnp.isfinite(cost) & jnp.isfinite(violation)
    return jnp.where(finite, status, Status.NON_FINITE).astype(jnp.int32)


def outcome(cost: Array, violation: Array, *, stationary: Array | bool = True) -> dict[str, PyTree]:
    """Return the fields that every `Plan` has, of a planner that does not iterate.

    Args:
        cost: (), the planner's own objective.
        violation: (), largest relative excess over a limit that the planner saw.
        stationary: () bool, whether another attempt could not change the plan.
    """
    return {
        "cost": cost,
        "violation": violation,
        "iterations": jnp.zeros_like(cost, jnp.int32),
        "status": status_of(cost, violation, stationary),
    }


@struct.dataclass
class Plan:
    """The outcome of planning; the plans of tasks add the motion.

    One plan, or a batch of them with a leading axis on every leaf.
    """

    cost: Array  # (), the planner's own objective
    violation: Array  # (), largest relative excess over a limit that the planner saw; <= 0 is good
    iterations: Array  # () int32
    status: Array  # () int32, a `Status`

    def save(self, path: str | os.PathLike) -> None:
        """Write the plan, or the batch, as NumPy's .npz; `load` of the same class reads it."""
        from planner_jax.core.plan_files import save_arrays

        save_arrays(path, self)

    @classmethod
    def load(cls, path: str | os.PathLike) -> Self:
        """Return the plan or batch that `save` wrote, with NumPy leaves.

        Raises:
            PlanFileError: the file does not hold plans, or plans of another class or version.
        """
        from planner_jax.core.plan_files import load_arrays

        return load_arrays(path, cls)


def require_settings(planner: PyTree) -> None:
    """Raise unless every field of a planner, a dataclass, is of the kind of its default.

    Sizes are whole numbers of 1 or more, 0 only where that is the default; weights and times are
    finite, and not negative where the default is not; attempts are one or more.

    Raises:
        ArgumentTypeError: a field is of another kind.
        ArgumentError: a field is too small, not finite, or has no attempt.
    """
    defaults = {field.name: field.default for field in dataclasses.fields(planner)}
    for name, value in fields_of(planner).items():
        usual = defaults[name]
        if isinstance(usual, bool):
            require_switch(name, value)
        elif isinstance(usual, int):
            require_size(name, value, min(usual, 1))
        elif isinstance(usual, float) and usual >= 0.0:
            require_number(name, value, NOT_NEGATIVE)
        elif isinstance(usual, float):
            require_number(name, value)
        elif isinstance(usual, tuple) and usual and isinstance(usual[0], Attempt):
            require_attempts(name, value, type(usual[0]))
        elif isinstance(usual, tuple):
            if not isinstance(value, tuple) or any(numeric(x) is None for x in value):
                raise ArgumentTypeError(name, "a tuple of numbers", value)
        elif dataclasses.is_dataclass(usual):
            require_kind(name, value, type(usual))


def require_attempts(name: str, value: object, kind: type) -> None:
    """Raise unless a setting is a tuple of one or more attempts of a class.

    Raises:
        ArgumentTypeError: it is something else.
        ArgumentError: it is empty.
    """
    if not isinstance(value, tuple) or not all(isinstance(each, kind) for each in value):
        raise ArgumentTypeError(name, f"a tuple of {kind.__name__}", value)
    if not value:
        raise ArgumentError(name, "an entry", verb="have", shown="none")


@dataclasses.dataclass(frozen=True)
class Attempt:
    """One try at the cases that earlier tries left unsolved; static under jit."""

    starts: int = 1  # lanes that one case takes in a batch
    # Cases that earlier attempts left with a greater violation are not tried; None: all are.
    within: float | None = dataclasses.field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        require_size("starts", self.starts)
        if self.within is not None:
            require_number("within", self.within, POSITIVE)

    def is_due(self, plans: "Plan") -> Array:
        """Return which of the plans so far this attempt may improve."""
        unsolved = is_unsolved(plans.status)
        return unsolved if self.within is None else unsolved & (plans.violation <= self.within)


PlanT = TypeVar("PlanT", bound=Plan)


@runtime_checkable
class Decision(Protocol):
    """A rule that decides what a case leaves open, such as an order; a pytree, as planners are.

    Examples are the best of all orders, the output of a network, and a fixed order.
    """

    def check(self, cases: PyTree, /) -> None:
        """Raise `ArgumentError` for a batch about which this cannot decide; on the host."""
        ...

    def propose(self, case: PyTree, /) -> PyTree:
        """Return choices for one case, best first, for `case.decided`; leaves (F, ...); pure."""
        ...

    def rank(self, plans: PyTree, /) -> Array:
        """Return one number a plan, which is least for the plan that is selected; pure.

        The plans have any batch shape, in NumPy or jax arrays.
        """
        ...

    def explain(self, case: PyTree, status: Array, /) -> Array:
        """Return the status () of an unsolved case, or a status that explains more; pure."""
        ...


Tree = TypeVar("Tree")


def out_of_time(plans: PlanT, left: Numbers | bool) -> PlanT:
    """Return the plans, with the status `OUT_OF_TIME` where one is left unsolved."""
    status = numpy_of(plans.status).where(left, Status.OUT_OF_TIME, plans.status).astype(np.int32)
    return dataclasses.replace(plans, status=status)  # type: ignore[type-var]


def is_resident(tree: PyTree) -> bool:
    """Return whether all leaves are jax arrays, which may lie on other devices than the host."""
    return all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(tree))


def take(tree: Tree, k: int | np.integer | slice | Numbers) -> Tree:
    """Return one case, plan or verdict of a batch, or some of them: entry `k` of every leaf.

    Args:
        tree: a pytree, or a dataclass of arrays such as a verdict, with a leading axis.
        k: an index, a slice, or an array of indices or of bool.
    """
    if dataclasses.is_dataclass(tree) and jax.tree_util.all_leaves([tree]):
        fields = {name: leaf[k] for name, leaf in fields_of(tree).items()}
        return dataclasses.replace(tree, **fields)  # type: ignore[type-var]
    return jax.tree.map(lambda leaf: leaf[k], tree)


def solved(plans: Plan) -> np.ndarray:
    """Return whether each plan keeps every limit of its planner, bool; see `Status`.

    Raises:
        ArgumentTypeError: the argument is not a plan or a batch of plans.
    """
    require_kind("plans", plans, Plan)
    return np.asarray(is_solved(plans.status))


def marked(plans: PlanT, cases: PyTree) -> PlanT:
    """Return the plans, with the status `BAD_INPUT` where a number of the case breaks a rule; pure.

    Args:
        plans: one plan, or a batch; the same plans are returned if the cases have no `rules`.
        cases: of the plans.
    """
    if not has_rules(cases):
        return plans
    status = numpy_of(plans.status).where(is_sound(cases), plans.status, Status.BAD_INPUT)
    status = status.astype(np.int32)
    return dataclasses.replace(plans, status=status)  # type: ignore[type-var]


# Which of several plans of a case is selected is one rule for every planner. A plan that keeps
# every limit is selected before one that does not. Of two that keep them the cheaper one is
# selected, and of two that do not the one that exceeds them less. The functions below take NumPy or
# jax arrays, and anything with `cost`, `violation` and, without a `tolerance`, `status`.
def is_better(
    later: PyTree, before: PyTree, *, tolerance: float | None = None, share: float = 1.0
) -> PyTree:
    """Return whether later plans are selected in the place of earlier ones, bool.

    Args:
        later: plans of any batch shape.
        before: plans of the same cases.
        tolerance: the greatest violation at which a plan counts as keeping every limit. By default
            its status says so.
        share: of the earlier cost, below which a plan that keeps limits, too, is cheaper.
    """
    if tolerance is None:
        is_good, was_good = is_solved(later.status), is_solved(before.status)
    else:
        is_good, was_good = later.violation <= tolerance, before.violation <= tolerance
    xp = numpy_of(was_good)
    is_cheaper = is_good & (later.cost < share * before.cost)
    is_farther = before.violation <= later.violation  # false, too, where either is NaN
    is_nearer = xp.isfinite(later.violation) & xp.logical_not(is_farther)
    return xp.where(was_good, is_cheaper, is_good | is_nearer)


def select(later: PlanT, before: PlanT, where: Array | bool = True) -> PlanT:
    """Return the plans, with later ones where these are better; pure.

    Args:
        later: plans of any batch shape.
        before: plans of the same cases.
        where: cases whose plans may change.
    """
    chosen = jnp.asarray(where & is_better(later, before))

    def pick(old: Array, new: Array) -> Array:
        return jnp.where(chosen.reshape(chosen.shape + (1,) * (new.ndim - chosen.ndim)), new, old)

    return jax.tree.map(pick, before, later)


def select_into(plans: PyTree, later: PyTree, lanes: np.ndarray) -> PyTree:
    """Return plans with NumPy leaves, changed in place where later plans of some lanes are better.

    Args:
        plans: a batch.
        later: plans of `lanes`, or of more lanes than these.
        lanes: indices of the batch.
    """
    later = jax.tree.map(lambda leaf: np.asarray(leaf)[: lanes.size], later)
    better = is_better(later, jax.tree.map(lambda leaf: leaf[lanes], plans))

    def replace(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        old[lanes[better]] = new[better]
        return old

    return jax.tree.map(replace, plans, later)


def index_of_best(plans: PyTree, cost: PyTree = None) -> PyTree:
    """Return the index along the first axis of the plan that is selected of each case's.

    Args:
        plans: the plans of a case one after another, (K, ...).
        cost: (K, ...), in the place of the planner's own.
    """
    xp = numpy_of(plans.status)
    good = is_solved(plans.status)
    finite = xp.isfinite(plans.cost) & xp.isfinite(plans.violation)
    by_cost = xp.where(good, plans.cost if cost is None else cost, xp.inf)
    by_violation = xp.where(finite, plans.violation, xp.inf)
    return xp.where(good.any(axis=0), by_cost, by_violation).argmin(axis=0)


def first_solved(plan_of: Callable[[Array], PlanT], num: Array | int, best: PlanT) -> PlanT:
    """Return the first of a line of plans of one case that is solved, or else the best; pure.

    Args:
        plan_of: makes the plan at a position () int32 of the line.
        num: () int32, of plans in the line.
        best: the plan that there is already; if it is solved, no other is made.
    """

    def next_one(state: tuple[Array, PlanT]) -> tuple[Array, PlanT]:
        position, best = state
        return position + 1, select(plan_of(position), best)

    def is_open(state: tuple[Array, PlanT]) -> Array:
        position, best = state
        return (position < num) & ~is_solved(best.status)

    return lax.while_loop(is_open, next_one, (jnp.zeros((), jnp.int32), best))[1]
