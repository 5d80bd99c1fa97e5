"""Public functions of the task `pj.group`: make and judge plans of a car that meets targets."""

from planner_jax.core.decision import Decision
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.referee.intercept import InterceptVerdict, referee_intercepts
from planner_jax.referee.intercept_group import referee_groups
from planner_jax.task.arguments import judge_by, require_settings
from planner_jax.task.decisions import find_decision
from planner_jax.task.group.case import InterceptGroup
from planner_jax.task.group.plan import GroupPlan
from planner_jax.task.group.spec import DECISIONS, TASK
from planner_jax.task.intercept.api import position_setting


def planner(
    name: str = "spacetime", *, decide: str | Decision = "best", **options: object
) -> DecidedPlanner[InterceptGroup, GroupPlan]:
    """Make a planner for groups: cases in which one car has to meet several targets.

    The planner first decides in which order to meet the targets. Then it plans the drive to one
    target after another with the intercept planner `spacetime`, each meeting as early as possible.

    Args:
        name: `spacetime`; `direct`, a fast planner for up to 40 targets, which searches no cells
            and improves the order while it plans; or a planner of another package.
        decide: how to find the order. "best" plans the orders that are estimated to end first, and
            selects the plan that ends first. "greedy" always meets next the target with the
            earliest estimated meeting. "search" improves this order by a local search, for many
            targets. "given" uses the orders in the cases. An object is also
            accepted: `Best(finalists=3)` plans only three orders.
        **options: fields of the planner's dataclass.

    Returns:
        A planner for `pj.plan`; its field `planner` is a `GroupIntercept` or a `DirectGroup`.

    Raises:
        ValueError: no planner or no decision has the requested name.
        TypeError: the planner's dataclass has no field of the name of an option.
    """
    return DecidedPlanner(TASK.make_planner(name, options), find_decision(DECISIONS, decide))


def judge(cases: InterceptGroup, plans: GroupPlan, **settings: object) -> InterceptVerdict:
    """Judge plans of groups by the referee, an independent check of the drive to every target.

    The verdict has the batch shape of the cases: `success`, reasons by `sentence(k)`, and measured
    quantities. The settings are keyword arguments of `referee_intercepts`. `TypeError` is raised
    for cases of other tasks, `ValueError` for different batch shapes or invalid settings.
    """
    require_settings(referee_intercepts, settings)
    if isinstance(cases, InterceptGroup):
        settings = {**position_setting(cases.shared.target), **settings}
    return judge_by(referee_groups, cases, plans, (InterceptGroup, GroupPlan), settings)
