"""How much plans cost beside the optimum that a long search finds."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from planner_jax.core.protocol import solved
from planner_jax.core.registry import Task
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.optimise.settings import LbfgsConfig, NewtonConfig, Round, Stage
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.planning.plan import plan

COMPARED = 1024  # plans of a batch that are looked at, at most
# One long search from the first guess: Newton's method ends it, which follows valleys to their end.
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
    """By how much plans cost more than those of a long search.

    That is `TO_THE_OPTIMUM` for a planner that minimises by rounds; for others the planner that
    their task's card names as a yardstick, with its own options.

    Args:
        planner: that made the plans; what it decided on first is kept.
        cases: a batch, of which the first `COMPARED` are looked at.
        plans: of them.
        devices: as for `plan`.
        card: of the planner's task, for its yardstick.

    Returns:
        (K,), relative, of the cases that both solve: 0.33 is 33 %. None where the planner has no
        rounds, and its task no yardstick for such cases.
    """
    cases, plans = jax.tree.map(lambda leaf: np.asarray(leaf[:COMPARED]), (cases, plans))
    if isinstance(planner, DecidedPlanner):
        cases, planner = cases.with_choice(plans.choice), planner.planner
    longer = _longer(planner, cases, card)
    if longer is None:
        return None
    best = plan(longer, cases, devices=devices)
    both = solved(plans) & solved(best)
    return plans.cost[both] / best.cost[both] - 1.0


def _longer(planner: Any, cases: Any, card: Task | None) -> Any:
    """The planner with whose costs those of a planner are compared, None if there is none."""
    if isinstance(planner, OptimisedPlanner):
        return to_the_optimum(planner)
    if card is None or card.yardstick is None:
        return None
    yardstick = card.planner(card.yardstick)
    # A task's groups, and what is planned again, are cases of other classes.
    return yardstick if isinstance(cases, yardstick.case_type) else None


def to_the_optimum(planner: OptimisedPlanner) -> OptimisedPlanner:
    """The planner with the long search in the place of its rounds."""
    return planner.with_settings((("rounds", (TO_THE_OPTIMUM,)),))


def gap_figures(*gaps: np.ndarray | None) -> dict[str, float | None]:
    """Median, 90 and 99 % quantile of `cost_gaps`, None where there are none."""
    together = np.concatenate([np.zeros(0), *(each for each in gaps if each is not None)])
    names = ("cost_gap_median", "cost_gap_p90", "cost_gap_p99")
    if not together.size:
        return dict.fromkeys(names)
    return dict(zip(names, np.quantile(together, (0.5, 0.9, 0.99)), strict=True))
