"""What became of one lane of a batched solve."""

import enum


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


SOLVED = (Status.CONVERGED, Status.FEASIBLE)

_MESSAGES = {
    Status.CONVERGED: "stationary, and every limit holds",
    Status.FEASIBLE: "every limit holds; more iterations may lower the cost",
    Status.INFEASIBLE: "stationary with a limit exceeded; try more starts, or relax the limit",
    Status.MAX_STEPS: "out of iterations with a limit exceeded; allow more iterations or starts",
    Status.NON_FINITE: "the scenario or its cost is not finite; check the scenario for NaN",
    Status.OUT_OF_REACH: "a target never comes within reach; `closest_approach` says by how much",
}
