"""One attempt at a batch, by planners of one case and by those with a layout of their own."""

from typing import Any

import jax

from planner_jax.protocol import Attempt, LanesPlanner


def solve_cases(planner: Any, cases: Any, attempt: Attempt) -> Any:
    """The plans of one case, or of a batch with a leading axis on every leaf; pure."""
    if cases.batch_shape == ():
        return planner.solve(cases, attempt)
    if isinstance(planner, LanesPlanner):
        return planner.solve_lanes(cases, attempt)
    return jax.vmap(lambda case: planner.solve(case, attempt))(cases)
