"""One plan at a time."""

from collections.abc import Sequence
from typing import Any

from planner_jax.core.planner import Planner
from planner_jax.core.protocol import Attempt, is_solved, is_unsolved, out_of_time
from planner_jax.planning.programs import solve_cases
from planner_jax.planning.progress import Watch
from planner_jax.planning.single_call import call_packed


def plan_single(planner: Planner, attempts: Sequence[Attempt], case: Any, watch: Watch) -> Any:
    """Attempts at one case until one of them solves it, or its time is over."""
    best: Any = None
    for attempt in attempts:
        if best is not None and not attempt.is_due(best):
            continue
        if best is not None and watch.is_over:
            return out_of_time(best, True)
        watch.tell(planner, attempt, 0, 1)
        plan = call_packed(_solved, attempt, planner, case)
        if best is None or is_solved(int(plan.status)) or plan.violation < best.violation:
            best = plan
        watch.tell(planner, attempt, 1, 1)
        if not is_unsolved(int(best.status)):  # of a number quicker to tell than of an array
            break
    return best


def _solved(attempt: Attempt, planner: Planner, case: Any) -> Any:
    return solve_cases(planner, case, attempt)
