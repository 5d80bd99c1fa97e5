"""The words of the task: `pj.intercept.draw`, `planner` and `judge`; `case` stands beside."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from planner_jax.core.checks import require_kind, require_path
from planner_jax.core.planner import Planner
from planner_jax.core.registry import suite_named
from planner_jax.plane.target import PlanePath
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.referee.intercept import InterceptVerdict, referee_intercepts
from planner_jax.referee.intercept_group import referee_groups
from planner_jax.task.group.case import GroupPlan, InterceptGroup
from planner_jax.task.group.suites import draw_groups
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan
from planner_jax.task.intercept.spec import DECISIONS, GROUPS, SUITES, TASK
from planner_jax.task.intercept.suites import draw_cases
from planner_jax.task.judged import judged, require_settings
from planner_jax.task.named_decision import named_decision


def draw(
    num: int,
    suite: str | None = None,
    seed: int = 0,
    *,
    first: int = 0,
    dtype: Any = jnp.float32,
) -> InterceptCase | InterceptGroup:
    """Drawn interceptions as a batch of cases; see `drawn` for how many draws were rejected.

    Args:
        num: how many, >= 1.
        suite: "easy", the default, "medium", "hard", "storm", "gale", "maze" or "rush"; or
            "group", of several targets each; or one that another package offers.
        seed: >= 0. Case k of a suite and seed is always the same one.
        first: place of the first one, >= 0.
        dtype: of every floating leaf.

    Raises:
        ValueError: an argument is out of its range, or there is no such suite.
    """
    suite = suite_named(suite, "easy")
    if suite in GROUPS:
        return draw_groups(suite, num, seed, first, dtype=dtype)
    if suite not in SUITES:
        return TASK.other_suite(suite)(num, seed, first)
    return draw_cases(suite, num, seed, first, dtype=dtype)


def planner(name: str = "spacetime", **options: Any) -> Planner[Any, Any]:
    """The intercept planner of a name, with some of its fields set.

    * `spacetime`: way and speed together, from a reach set in space and time.
    * `quick`: the same with fewer ways and steps, for large batches on a GPU.
    * `best`: the same with more ways and steps, of which the plan of least effort is kept.
    * `lattice`: a path among what stands, then a speed along it among what moves, on eight paths
      from a reach set; the best one is kept.
    * `paper`: one path by Hybrid A*, smoothed, then a speed along it, as paper 003 has it; on the
      host, with the extra `baselines`.
    * `em`: the best path of `lattice` with the speed step of the EM planner.
    * `constant`: the best path of `lattice` at constant speed, whatever moves.
    * `group`: groups of targets, one after another by `spacetime`, each as early as it is found
      to be met, behind a decision about their order.

    Args:
        name: one of these, or one that another package offers.
        **options: fields of that planner's dataclass, for example `pieces` of `spacetime`. That of
            `group` takes `decide` besides: "best", the default, plans the most promising of all
            orders and keeps the earliest last meeting, "greedy" meets next what it can meet
            first, as estimated, "given" takes the order of the cases; or a decision with
            settings, such as `Best(finalists=3)`.

    Returns:
        A planner for `pj.plan`: `SpacetimeIntercept`, `PathThenSpeed` or `PaperIntercept`; for
        groups a `DecidedPlanner`, whose `planner` is a `GroupIntercept`.

    Raises:
        ValueError: there is no planner or decision of that name.
        TypeError: the planner has no such field.
    """
    if name != "group":
        return TASK.make_planner(name, options)
    decide = options.pop("decide", "best")
    return DecidedPlanner(TASK.make_planner(name, options), named_decision(DECISIONS, decide))


def judge(
    cases: InterceptCase | InterceptGroup, plans: InterceptPlan | GroupPlan, **settings: Any
) -> InterceptVerdict:
    """What the referee says of one plan or of a batch: the physics alone decides.

    Args:
        cases: one case, or a batch; or groups.
        plans: of them.
        **settings: such as `tolerance`, and but for groups `truth`: a path, or a batch of them,
            that the target really takes, where the case holds one that was predicted; see
            `referee_intercepts`.

    Returns:
        A verdict with the batch shape of the cases: `success`, `sentence(k)`, and what was
        measured. Of groups every leg is judged, see `referee_groups`.

    Raises:
        TypeError: the cases or plans are not interceptions.
        ValueError: shapes that do not fit, or a setting out of its range.
    """
    if isinstance(cases, InterceptGroup):
        require_settings(referee_intercepts, settings)
        settings = {"target_positions": positions, **settings}
        return judged(referee_groups, cases, plans, (InterceptGroup, GroupPlan), settings)
    require_kind("cases", cases, InterceptCase)
    if (truth := settings.get("truth")) is not None:
        require_path("truth", truth, cases.batch_shape, 2)
        if cases.batch_shape == ():
            one = jax.tree.map(lambda leaf: np.asarray(leaf)[None], truth)
            settings = {**settings, "truth": one}
    settings = {"target_positions": positions, **settings}
    return judged(referee_intercepts, cases, plans, (InterceptCase, InterceptPlan), settings)


def positions(target: PlanePath, times: np.ndarray) -> np.ndarray:
    """Where targets (B,) of any class are at their times (B,), (B, 2) [m], in float64."""
    with jax.enable_x64(True):
        double = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), target)
        return np.asarray(jax.vmap(lambda path, time: path.at(time).pos)(double, times))
