"""What became of one lane of a batched solve."""

import enum
from typing import Any


class Status(enum.IntEnum):
    """Outcome of one lane; `message` says what it means and what to do about it."""

    CONVERGED = 0
    FEASIBLE = 1
    INFEASIBLE = 2
    MAX_STEPS = 3
    NON_FINITE = 4
    OUT_OF_REACH = 5

    @property
    def message(self) -> str:
        """A sentence for the user, with the remedy."""
        return _MESSAGES[self]

    @classmethod
    def _missing_(cls, value: Any) -> "Status | None":
        """The status that a jax array of one number holds; arrays are no keys of the lookup."""
        return next((status for status in cls if status == value), None)


_MESSAGES = {
    Status.CONVERGED: "stationary, and every limit holds",
    Status.FEASIBLE: "every limit holds; more iterations may lower the cost",
    Status.INFEASIBLE: "stationary with a limit exceeded; try more starts, or relax the limit",
    Status.MAX_STEPS: "out of iterations with a limit exceeded; allow more iterations or starts",
    Status.NON_FINITE: "the scenario or its cost is not finite; check the scenario for NaN",
    Status.OUT_OF_REACH: "a target never comes within reach; `closest_approach` says by how much",
}


def is_solved(status: Any) -> Any:
    """Which statuses are those of a plan that meets every limit the planner looked at."""
    return (status == Status.CONVERGED) | (status == Status.FEASIBLE)


def is_unsolved(status: Any) -> Any:
    """Which lanes are worth another round: not solved, and not broken either."""
    return (status >= Status.INFEASIBLE) & (status != Status.NON_FINITE)
