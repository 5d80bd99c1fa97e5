"""Results of planning with their status, the rule that selects the best, and search settings."""

import dataclasses
import enum
import os
from collections.abc import Sequence
from typing import ClassVar, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.core.arithmetic import Numbers, numpy_of, to_host
from planner_jax.core.checks import (
    require_kind,
    require_number,
    require_numbers,
    require_switch,
)
from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.core.rules import FINITE, NOT_NEGATIVE, POSITIVE, fields_of, is_sound


class Status(enum.IntEnum):
    """The outcome of planning one case; `message` explains the status and states a remedy."""

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
        """A sentence that explains the status, and how the user may solve the case."""
        return _MESSAGES[self]

    @classmethod
    def _missing_(cls, value: object) -> "Status | None":
        """Return the status equal to a jax array of one number, as in `Status(plan.status)`."""
        return next((status for status in cls if status == value), None)


_MESSAGES = {
    Status.CONVERGED: "stationary, and every limit holds",
    Status.FEASIBLE: "every limit holds; more iterations may lower the cost",
    Status.INFEASIBLE: "stationary with a limit exceeded; try more starts, or relax the limit",
    Status.MAX_STEPS: "out of iterations with a limit exceeded; allow more iterations or starts",
    Status.NON_FINITE: "`cost` or `violation` of the plan is not finite; bring the case's numbers "
    "nearer to one",
    Status.OUT_OF_REACH: "a target never comes within reach; `closest_approach` has the distance",
    Status.NO_PATH: "no path through the obstacles was found in time; allow more time",
    Status.BLOCKED: "the start or the goal lies in an obstacle or off the map; move it",
    Status.BAD_INPUT: "a number of the case breaks its rule; `pj.require_sound(cases)` names it",
    Status.TOO_FAR: "no plan exists: the robot cannot be at a target's position at any time; allow "
    "more speed or acceleration, or start nearer",
    Status.OUT_OF_TIME: "a limit is exceeded, and `time_limit` ended the search; allow more time",
}


def is_solved(status: Numbers | int) -> Array:
    """Return which statuses belong to plans that keep every limit of their planner, bool."""
    return (status == Status.CONVERGED) | (status == Status.FEASIBLE)  # type: ignore[return-value]


def is_unsolved(status: Numbers | int) -> Array:
    """Return where a status is INFEASIBLE, MAX_STEPS or OUT_OF_REACH: another search may help."""
    worth = (status == Status.INFEASIBLE) | (status == Status.MAX_STEPS)
    return worth | (status == Status.OUT_OF_REACH)  # type: ignore[return-value]


# Greatest relative excess over a limit that planners accept. The referee, an independent check of
# plans, accepts 1e-3; the difference is reserved for peaks between the planner's samples.
FEASIBILITY_TOLERANCE = 5e-4


def status_of(cost: Array, violation: Array, stationary: Array | bool) -> Array:
    """Return the `Status` of a plan from its cost, violation and stationarity, () int32.

    The status is NON_FINITE if cost or violation is not finite. A plan whose violation is at most
    `FEASIBILITY_TOLERANCE` is CONVERGED if stationary, else FEASIBLE. Any other plan is INFEASIBLE
    if stationary, else MAX_STEPS.
    """
    feasible = violation <= FEASIBILITY_TOLERANCE
    status = jnp.where(
        feasible,
        jnp.where(stationary, Status.CONVERGED, Status.FEASIBLE),
        jnp.where(stationary, Status.INFEASIBLE, Status.MAX_STEPS),
    )
    finite = jnp.isfinite(cost) & jnp.isfinite(violation)
    return jnp.where(finite, status, Status.NON_FINITE).astype(jnp.int32)


@struct.dataclass
class Plan:
    """The outcome of planning: cost, violation and status; the subclasses of tasks add the motion.

    An object holds one plan, or a batch of plans with a leading axis on every leaf.

    Attributes:
        cost: () the planner's own objective.
        violation: () largest relative excess over a limit that the planner checks; at most 5e-4 is
            accepted.
        iterations: () int32, number of the search's iterations.
        status: () int32, outcome of the search, a `Status`.
    """

    cost: Array
    violation: Array
    iterations: Array
    status: Array

    def save(self, path: str | os.PathLike) -> None:
        """Write the plan, or the batch, as NumPy's .npz, for `load` of the same class."""
        from planner_jax.core.plan_files import save_arrays

        save_arrays(path, self)

    @classmethod
    def load(cls, path: str | os.PathLike) -> Self:
        """Return the plan or batch that `save` wrote, in NumPy arrays.

        Raises:
            PlanFileError: the file holds no plans, or plans of another class or version.
        """
        from planner_jax.core.plan_files import load_arrays

        return load_arrays(path, cls)


def require_settings(planner: PyTree) -> None:
    """Raise unless every field of a planner, a dataclass, has the kind of its default value.

    Sizes are whole numbers >= 1, or >= 0 if the default is 0. Weights and times are finite, and >=
    0 unless the default is negative. There must be at least one attempt (search).
    """
    defaults = {field.name: field.default for field in dataclasses.fields(planner)}
    for name, value in fields_of(planner).items():
        default = defaults[name]
        if isinstance(default, bool):
            require_switch(name, value)
        elif isinstance(default, int):
            require_size(name, value, min(default, 1))
        elif isinstance(default, float):
            require_number(name, value, NOT_NEGATIVE if default >= 0.0 else FINITE)
        elif isinstance(default, tuple) and default and isinstance(default[0], BaseAttempt):
            require_attempts(name, value, type(default[0]))
        elif isinstance(default, tuple):
            require_numbers(name, value)
        elif dataclasses.is_dataclass(default):
            require_kind(name, value, type(default))


def require_attempts(name: str, value: object, kind: type) -> None:
    """Raise `ArgumentError` unless `value` is a tuple of one or more objects of class `kind`."""
    if not isinstance(value, tuple) or not all(isinstance(each, kind) for each in value):
        raise ArgumentTypeError(name, f"a tuple of {kind.__name__}", value)
    if not value:
        raise ArgumentError(name, "an entry", verb="have", shown="none")


@dataclasses.dataclass(frozen=True)
class BaseAttempt:
    """Settings of one search for cases that earlier attempts left unsolved; static under jit.

    Attributes:
        starts: number of starting points from which each case is solved.
        within: greatest violation (relative excess over a limit) of a case that is searched
            further; None: any violation.
        improves: whether solved cases are searched, too. The plan that costs less is selected.
    """

    continues: ClassVar[bool] = False  # whether a search needs the numbers of the best plans so far
    starts: int = 1
    within: float | None = dataclasses.field(default=None, kw_only=True)
    improves: bool = dataclasses.field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        require_size("starts", self.starts)
        if self.within is not None:
            require_number("within", self.within, POSITIVE)

    def place_among(self, attempts: Sequence["BaseAttempt"]) -> int:
        """Return its index among a planner's attempts, or 0 if it is none of them."""
        return attempts.index(self) if self in attempts else 0

    def is_due(self, plans: "Plan") -> Array:
        """Return which plans need this search, bool: unsolved, and violation <= `within`.

        If the search improves plans, solved plans need it, too.
        """
        due = is_unsolved(plans.status)
        if self.within is not None:
            due &= plans.violation <= self.within
        return due | is_solved(plans.status) if self.improves else due


PlanT = TypeVar("PlanT", bound=Plan)


@struct.dataclass
class Score:
    """The numbers of plans by which they are compared with other plans; see `is_better`."""

    cost: Array | np.ndarray
    violation: Array | np.ndarray
    status: Array | np.ndarray

    @classmethod
    def of(cls, plans: Plan) -> "Score":
        """Return the numbers of plans, of any batch shape."""
        return cls(plans.cost, plans.violation, plans.status)

    @classmethod
    def none(cls, batch: tuple[int, ...], dtype: np.dtype) -> "Score":
        """Return NumPy numbers of cases without plans; every finite plan is better."""
        unsolved = np.full(batch, Status.INFEASIBLE, np.int32)
        return cls(np.zeros(batch, dtype), np.full(batch, np.inf, dtype), unsolved)

    def without(self, is_padding: Numbers) -> "Score":
        """Return the numbers with a status for which no search is made, where a mask is true."""
        status = numpy_of(self.status).where(is_padding, Status.BAD_INPUT, self.status)
        return dataclasses.replace(self, status=status.astype(np.int32))


Tree = TypeVar("Tree")


def mark_out_of_time(plans: PlanT, left: Numbers | bool) -> PlanT:
    """Return the plans with the status `OUT_OF_TIME` where `left` is true and none is solved."""
    left = left & ~is_solved(plans.status)
    status = numpy_of(plans.status).where(left, Status.OUT_OF_TIME, plans.status).astype(np.int32)
    return dataclasses.replace(plans, status=status)  # type: ignore[type-var]


def is_resident(tree: PyTree) -> bool:
    """Return whether all arrays of a pytree are jax arrays, which may be on another device."""
    return all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(tree))


def take(tree: Tree, k: int | np.integer | slice | Numbers) -> Tree:
    """Return one case, plan or verdict of a batch, or several: entry `k` of each of its arrays.

    Args:
        tree: a pytree, or a dataclass of arrays such as a verdict, with a leading axis.
        k: an index, a slice, or an array of indices or of bool.
    """
    if dataclasses.is_dataclass(tree) and jax.tree_util.all_leaves([tree]):
        fields = {name: leaf[k] for name, leaf in fields_of(tree).items()}
        return dataclasses.replace(tree, **fields)  # type: ignore[type-var]
    return jax.tree.map(lambda leaf: leaf[k], tree)


def are_solved(plans: Plan) -> PyTree:
    """Return whether each plan keeps every limit that its planner checks, bool; traced if they are.

    Raises:
        ArgumentTypeError: the argument is not a plan or a batch of plans.
    """
    require_kind("plans", plans, Plan)
    return to_host(is_solved(plans.status))


def mark_bad_input(plans: PlanT, cases: PyTree) -> PlanT:
    """Return plans with status `BAD_INPUT` for cases with NaN or out-of-range numbers; pure."""
    status = numpy_of(plans.status).where(is_sound(cases), plans.status, Status.BAD_INPUT)
    status = status.astype(np.int32)
    return dataclasses.replace(plans, status=status)  # type: ignore[type-var]


# One rule selects among several plans of a case, for every planner. A plan that keeps every limit
# comes before a plan that does not. Among plans that keep every limit the cheapest is selected,
# otherwise the plan with the least violation. The functions below take NumPy or jax arrays, and any
# object with `cost`, `violation` and, without a `tolerance`, `status`.
def is_better(
    later: PyTree, before: PyTree, *, tolerance: float | None = None, share: float = 1.0
) -> PyTree:
    """Return whether later plans are selected instead of earlier ones, bool.

    Args:
        later: plans of any batch shape.
        before: plans of the same cases.
        tolerance: greatest violation of a solved plan. By default the plan's status decides.
        share: factor on the earlier cost; the later plan must cost less than this product.
    """
    if tolerance is None:
        is_good, was_good = is_solved(later.status), is_solved(before.status)
    else:
        is_good, was_good = later.violation <= tolerance, before.violation <= tolerance
    xp = numpy_of(was_good)
    is_cheaper = is_good & (later.cost < share * before.cost)
    is_farther = before.violation <= later.violation  # false if one of them is NaN
    is_nearer = xp.isfinite(later.violation) & xp.logical_not(is_farther)
    return xp.where(was_good, is_cheaper, is_good | is_nearer)


def select(later: PlanT, before: PlanT, where: Array | bool = True) -> PlanT:
    """Return the better of later and earlier plans, case by case where `where` is true; pure."""
    chosen = jnp.asarray(where & is_better(later, before))

    def pick(old: Array, new: Array) -> Array:
        return jnp.where(chosen.reshape(chosen.shape + (1,) * (new.ndim - chosen.ndim)), new, old)

    return jax.tree.map(pick, before, later)


def select_into(plans: PyTree, later: PyTree, lanes: np.ndarray) -> PyTree:
    """Replace plans, in place in NumPy arrays, by later plans of the same cases that are better.

    `lanes` are the indices of these cases in the batch. If there are more later plans than
    indices, the surplus plans are padding and are ignored.
    """
    later = jax.tree.map(lambda leaf: np.asarray(leaf)[: lanes.size], later)
    better = is_better(later, jax.tree.map(lambda leaf: leaf[lanes], plans))

    def replace(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        old[lanes[better]] = new[better]
        return old

    return jax.tree.map(replace, plans, later)
