"""The words of the task: `pj.intercept.draw`, `planner` and `judge`; `case` stands beside."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.plane.target import PlanePath
from planner_jax.protocol import AnyPlanner
from planner_jax.referee.intercept import InterceptVerdict, referee_intercepts
from planner_jax.task.intercept.card import TASK
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.suites import draw_cases
from planner_jax.task.judged import judged


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    dtype: Any = jnp.float32,
) -> InterceptCase:
    """Drawn interceptions as a batch of cases; see `drawn` for how many draws were rejected.

    Args:
        num: how many, >= 1.
        suite: "easy", the default, "medium", "hard", "storm", "gale", "maze" or "rush", or
            one that another package offers.
        seed: >= 0. Case k of a suite and seed is always the same one.
        first: place of the first one, >= 0.
        dtype: of every floating leaf.

    Raises:
        ValueError: an argument is out of its range, or there is no such suite.
    """
    suite = suite or "easy"
    if suite not in TASK.suites:
        return TASK.other_suite(suite)(num, seed, first)
    return draw_cases(suite, num, seed, first, dtype=dtype)


def planner(name: str = "spacetime", **options: Any) -> AnyPlanner[InterceptCase, InterceptPlan]:
    """The intercept planner of a name, with some of its fields set.

    * `spacetime`: way and speed together, from a reach set in space and time.
    * `lattice`: a path among what stands, then a speed along it among what moves, on eight paths
      from a reach set; the best one is kept.
    * `paper`: one path by Hybrid A*, smoothed, then a speed along it, as paper 003 has it; on the
      host, with the extra `baselines`.
    * `em`: the best path of `lattice` with the speed step of the EM planner.
    * `constant`: the best path of `lattice` at constant speed, whatever moves.

    Args:
        name: one of these, or one that another package offers.
        **options: fields of that planner's dataclass, for example `pieces` of `spacetime`.

    Returns:
        A planner for `pj.plan`: `SpacetimeIntercept`, `PathThenSpeed` or `PaperIntercept`.

    Raises:
        ValueError: there is no planner of that name.
        TypeError: the planner has no such field.
    """
    return TASK.make_planner(name, options)


def judge(cases: InterceptCase, plans: InterceptPlan, **settings: Any) -> InterceptVerdict:
    """What the referee says of one plan or of a batch: the physics alone decides.

    Args:
        cases: one case, or a batch.
        plans: of them.
        **settings: such as `tolerance`, and `truth`: a path, or a batch of them, that the target
            really takes, where the case holds one that was predicted; see `referee_intercepts`.

    Returns:
        A verdict with the batch shape of the cases: `success`, `sentence(k)`, and what was
        measured.

    Raises:
        TypeError: the cases or plans are not interceptions.
        ValueError: shapes that do not fit, or a setting out of its range.
    """
    if cases.batch_shape == () and settings.get("truth") is not None:
        one = jax.tree.map(lambda leaf: np.asarray(leaf)[None], settings["truth"])
        settings = {**settings, "truth": one}
    settings = {"target_positions": positions, **settings}
    return judged(referee_intercepts, cases, plans, (InterceptCase, InterceptPlan), settings)


def positions(target: PlanePath, times: np.ndarray) -> np.ndarray:
    """Where targets (B,) of any class are at their times (B,), (B, 2) [m], in float64."""
    with jax.enable_x64(True):
        double = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), target)
        return np.asarray(jax.vmap(lambda path, time: path.at(time).pos)(double, times))
