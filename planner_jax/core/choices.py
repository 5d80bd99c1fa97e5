"""Names and ranges that planners, settings and exports share, and checks of arguments by them.

Nothing here imports JAX or NumPy: the command line checks its options with this module.
"""

import os
from collections.abc import Iterable
from numbers import Integral
from typing import Protocol, Self, TypeVar

from planner_jax.core.errors import ArgumentError, ArgumentTypeError
from planner_jax.host import machine

EFFORTS = ("feasible", "good", "best")  # default first
RECOVERIES = ("brake", "home")  # to a standstill where that is cheapest, or where the case begins
NONE = "none"  # as a setting has it: a plan that ends at its last contact
CHOICES = (NONE, *RECOVERIES)
SCALES = (1e-3, 1e3)  # factors on limits; beyond these, limits are not those of a machine


class Searching(Protocol):
    """A planner, as far as its effort is concerned."""

    def with_effort(self, effort: str) -> Self:
        """Return the planner with a longer search."""
        ...


PlannerT = TypeVar("PlannerT", bound=Searching)


def with_effort(planner: PlannerT, effort: str) -> PlannerT:
    """Return a planner whose first round, which all cases go through, searches for longer.

    "feasible" leaves the planner as it is: a case is done as soon as every limit holds, which is
    quickest, and costs are far from the least. See `OptimisedPlanner.with_effort` for the others.

    Raises:
        ArgumentError: another word, or the planner has no rounds.
    """
    require_one_of(EFFORTS, "effort", effort)
    return planner if effort == EFFORTS[0] else planner.with_effort(effort)


def require(
    holds: bool, name: str, rule: str, value: object = None, *, shown: str | None = None
) -> None:
    """Raise `ArgumentError` unless a rule on an argument holds."""
    if not holds:
        raise ArgumentError(name, rule, value, shown=shown)


def require_one_of(names: Iterable[str], name: str, value: object) -> None:
    """Raise `ArgumentError` unless an argument is one of some words."""
    names = tuple(names)
    require(value in names, name, f"one of {', '.join(names)}", value)


def require_size(name: str, value: object, least: int = 1) -> None:
    """Raise unless an argument is a whole number that is neither too small nor beyond 64 bits."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise ArgumentTypeError(name, "a whole number", value)
    require(int(value) >= least, name, f">= {least}", value)
    require(int(value) < 2**63, name, "< 2**63", value)


def require_seed(value: object) -> None:
    """Raise unless the argument `seed` is one of all random generators."""
    require_size("seed", value, 0)


def require_scale(value: float) -> None:
    """Raise `ArgumentError` unless the argument `limit_scale` leaves limits of a machine."""
    least, most = SCALES
    require(least <= value <= most, "limit_scale", f"from {least:g} to {most:g}", value)


def require_memory(name: str, num: int, bytes_each: int) -> None:
    """Raise `ArgumentError` if `num` elements of `bytes_each` bytes exceed the free memory.

    Args:
        name: argument that asks for the elements.
        num: number of elements.
        bytes_each: estimated size of one element.
    """
    free = machine.available_memory()
    _require_space(name, num, bytes_each, free, "which this machine has memory")


def require_disk(name: str, num: int, bytes_each: int, folder: str | os.PathLike) -> None:
    """Raise `ArgumentError` if rows would not fit on the disk of a folder, which may not exist.

    Args:
        name: argument that asks for the rows.
        num: number of rows.
        bytes_each: estimated size of one row.
        folder: folder of the rows.
    """
    _require_space(name, num, bytes_each, machine.free_disk(folder), "which the disk has room")


def _require_space(name: str, num: int, bytes_each: int, free: int | None, what: str) -> None:
    """Raise `ArgumentError` unless `num` elements fit into the free bytes; None is unknown."""
    if free is not None and num * bytes_each > free:
        sizes = f"{machine.format_size(bytes_each)} each, {machine.format_size(free)} free"
        most = max(free // bytes_each, 1)
        raise ArgumentError(name, f"at most {most:,}, for {what} ({sizes})", num)
