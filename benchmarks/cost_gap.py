"""How much plans cost beside those of a longer search."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from planner_jax.optimise.lbfgs import LbfgsConfig
from planner_jax.optimise.planner import OptimisedPlanner
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.planning.plan import plan
from planner_jax.protocol import solved
from planner_jax.registry import Task

COMPARED = 1024  # plans of a batch that are looked at, at most
# Beside which even plans are looked at whose own search is long.
VERY_LONG = LbfgsConfig(max_steps=3000, memory=12, tolerance=1e-9, patience=30)
_LONGEST = 100  # iterations of a first round for which a long search is yardstick enough


def cost_gaps(
    planner: Any,
    cases: Any,
    plans: Any,
    devices: Sequence[Any] | None = None,
    *,
    card: Task | None = None,
    solver: LbfgsConfig | None = None,
) -> np.ndarray | None:
    """By how much plans cost more than those of a longer search.

    That is a long one from the same guess, for a planner that minimises by rounds; for others the
    planner that their task's card names as a yardstick, with its own options.

    Args:
        planner: that made the plans; what it decided on first is kept.
        cases: a batch, of which the first `COMPARED` are looked at.
        plans: of them.
        devices: as for `plan`.
        card: of the planner's task, for its yardstick.
        solver: of the longer search; by default a long one, and `VERY_LONG` where the planner's own
            first round is longer than most.

    Returns:
        (K,), relative, of the cases that both solve: 0.33 is 33 %. None where the planner has no
        rounds, and its task no yardstick for such cases.
    """
    cases, plans = jax.tree.map(lambda leaf: np.asarray(leaf[:COMPARED]), (cases, plans))
    if isinstance(planner, DecidedPlanner):
        cases, planner = cases.decided(plans.choice), planner.planner
    longer = _longer(planner, cases, card, solver)
    if longer is None:
        return None
    best = plan(longer, cases, devices=devices)
    both = solved(plans) & solved(best)
    return plans.cost[both] / best.cost[both] - 1.0


def _longer(planner: Any, cases: Any, card: Task | None, solver: LbfgsConfig | None) -> Any:
    """The planner with whose costs those of a planner are compared, None if there is none."""
    if isinstance(planner, OptimisedPlanner):
        if solver is None and planner.rounds[0].solver.max_steps > _LONGEST:
            solver = VERY_LONG
        return planner.with_solver() if solver is None else planner.with_solver(solver)
    if card is None or card.yardstick is None:
        return None
    yardstick = card.planner(card.yardstick)
    # A task's groups, and what is planned again, are cases of other classes.
    kind = getattr(yardstick, "case_type", None)
    return yardstick if kind is None or isinstance(cases, kind) else None


def gap_figures(*gaps: np.ndarray | None) -> dict[str, float | None]:
    """Median and 90 % quantile of `cost_gaps`, None where there are none."""
    together = np.concatenate([np.zeros(0), *(each for each in gaps if each is not None)])
    median, p90 = np.quantile(together, (0.5, 0.9)) if together.size else (None, None)
    return {"cost_gap_median": median, "cost_gap_p90": p90}
