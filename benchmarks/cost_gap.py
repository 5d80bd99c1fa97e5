"""Compare the costs of plans with the optimum that a long search finds."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from planner_jax.core.protocol import are_solved
from planner_jax.core.registry import Task
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.optimise.settings import LbfgsConfig, NewtonConfig, Round, Stage
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.planning.plan import plan

COMPARED = 1024  # maximum number of plans of a batch that are compared
# One long search from the first guess: L-BFGS, then Newton's method, which converges along
# ill-conditioned directions too.
TO_THE_OPTIMUM = Round(
    solver=NewtonConfig(max_steps=100, tolerance=1e-8, patience=10),
    stages=(Stage(LbfgsConfig(max_steps=200, tolerance=1e-6, patience=5)),),
)


def cost_gaps(
    planner: Any,
    cases: Any,
    plans: Any,
    devices: Sequence[Any] | None = None,
    *,
    card: Task | None = None,
) -> np.ndarray | None:
    """Return the relative excess of plans' costs over the costs of a long search.

    The long search is `TO_THE_OPTIMUM` for a planner that minimises by rounds. For any other
    planner it is the planner that the task specification names as a yardstick, with that planner's
    defaults.

    Args:
        planner: the planner that made the plans. If it also decides (`DecidedPlanner`), the long
            search uses the same decisions.
        cases: a batch; only the first `COMPARED` cases are compared.
        plans: one plan for each case.
        devices: as for `plan`.
        card: specification of the planner's task, for its yardstick.

    Returns:
        (K,), relative (0.33 is 33 %), for the cases that both planners solve. None if the planner
        has no rounds and the task has no yardstick for such cases.
    """
    cases, plans = jax.tree.map(lambda leaf: np.asarray(leaf[:COMPARED]), (cases, plans))
    if isinstance(planner, DecidedPlanner):
        cases, planner = cases.with_choice(plans.choice), planner.planner
    longer = _reference_planner(planner, cases, card)
    if longer is None:
        return None
    best = plan(longer, cases, devices=devices)
    both = are_solved(plans) & are_solved(best)
    return plans.cost[both] / best.cost[both] - 1.0


def _reference_planner(planner: Any, cases: Any, card: Task | None) -> Any:
    """Return the planner that provides the reference costs, or None if there is none."""
    if isinstance(planner, OptimisedPlanner):
        return with_long_search(planner)
    if card is None or card.yardstick is None:
        return None
    yardstick = card.planner(card.yardstick)
    # Groups of a task and re-planning problems are cases of other classes.
    return yardstick if isinstance(cases, yardstick.case_type) else None


def with_long_search(planner: OptimisedPlanner) -> OptimisedPlanner:
    """Return a copy of the planner whose rounds are replaced by the long search."""
    return planner.with_settings((("rounds", (TO_THE_OPTIMUM,)),))


def gap_figures(*gaps: np.ndarray | None) -> dict[str, float | None]:
    """Return the median, 90 % and 99 % quantile of `cost_gaps`; None if there are no gaps."""
    together = np.concatenate([np.zeros(0), *(each for each in gaps if each is not None)])
    names = ("cost_gap_median", "cost_gap_p90", "cost_gap_p99")
    if not together.size:
        return dict.fromkeys(names)
    return dict(zip(names, np.quantile(together, (0.5, 0.9, 0.99)), strict=True))
