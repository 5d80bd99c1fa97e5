"""How much a planner that minimises is asked to do; imports no JAX."""

from typing import Any

EFFORTS = ("feasible", "good", "best")  # default first


def with_effort(planner: Any, effort: str) -> Any:
    """A planner whose first round, which all cases go through, searches for longer.

    "feasible" leaves the planner as it is: a case is done as soon as every limit holds, which is
    quickest, and costs are far from the least. See `OptimisedPlanner.with_effort` for the others.

    Raises:
        ValueError: another word, or the planner has no rounds.
    """
    if effort not in EFFORTS:
        raise ValueError(f"effort must be one of {', '.join(EFFORTS)}, got {effort!r:.60}")
    if effort == EFFORTS[0]:
        return planner
    return planner.with_effort(effort)
