"""Compare the costs of plans with the optimal costs, which a long search finds.

Benchmarks of speed use it, to report how much cheaper the plans could be.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from planner_jax.core.protocol import are_solved
from planner_jax.core.registry import Task
from planner_jax.optimise.planner import SearchPlanner
from planner_jax.optimise.settings import Attempt, LbfgsConfig, NewtonConfig, Stage
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.planning.plan import plan

COMPARED = 1024  # Maximum number of plans of a batch that are compared with a long search.
# The long search starts from the planner's initial guess. It runs L-BFGS, then Newton's method,
# which also converges along directions in which the cost changes very little.
TO_THE_OPTIMUM = Attempt(
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
    """Return by what fraction the costs of plans exceed the costs that a long search finds.

    For a `SearchPlanner`, the long search is L-BFGS and then Newton's method. For any other
    planner it is the planner that the task specification names as `yardstick`, or the planner
    itself with the yardstick's effort if both have the same class.

    Args:
        planner: the planner that made the plans. If it also decides the order and times of
            contacts (`DecidedPlanner`), the long search uses the same decisions.
        cases: a batch; only the first 1,024 cases (`COMPARED`) are compared.
        plans: one plan for each case.
        devices: devices of the long search; None for all devices.
        card: specification of the planner's task, which may name a `yardstick`. With None the
            result is None for a planner that does not minimise a cost.

    Returns:
        (K,), cost / best cost - 1 for the K cases that both searches solve. None if the planner
            does not minimise a cost and the task names no other planner for this class of cases.
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
    if isinstance(planner, SearchPlanner):
        return with_long_search(planner)
    if card is None or not card.yardstick:
        return None
    yardstick = card.planner(**card.yardstick)
    if type(planner) is type(yardstick) and "effort" in card.yardstick:
        return planner.with_effort(str(card.yardstick["effort"]))
    return yardstick if isinstance(cases, yardstick.case_type) else None


def with_long_search(planner: SearchPlanner) -> SearchPlanner:
    """Return a copy of the planner whose only search is long, so that it finds the optimum."""
    return dataclasses.replace(planner, attempts=(TO_THE_OPTIMUM,))


def gap_figures(*gaps: np.ndarray | None) -> dict[str, float | None]:
    """Return the median, 90 % and 99 % quantile of relative excess costs of plans, by name.

    `gaps` are arrays of cost / best cost - 1, which are concatenated; None stands for no array.
    Without any number the quantiles are None.
    """
    together = np.concatenate([np.zeros(0), *(each for each in gaps if each is not None)])
    names = ("cost_gap_median", "cost_gap_p90", "cost_gap_p99")
    if not together.size:
        return dict.fromkeys(names)
    return dict(zip(names, np.quantile(together, (0.5, 0.9, 0.99)), strict=True))
