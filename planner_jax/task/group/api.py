"""The functions `pj.group.planner` and `pj.group.judge`."""

from planner_jax.core.protocol import Decision
from planner_jax.planning.decided import DecidedPlanner
from planner_jax.referee.intercept import InterceptVerdict, referee_intercepts
from planner_jax.referee.intercept_group import referee_groups
from planner_jax.task.arguments import find_decision, judge_by, require_settings
from planner_jax.task.group.case import InterceptGroup
from planner_jax.task.group.plan import GroupPlan
from planner_jax.task.group.spec import DECISIONS, TASK
from planner_jax.task.intercept.api import position_setting


def planner(
    name: str = "spacetime", *, decide: str | Decision = "best", **options: object
) -> DecidedPlanner[InterceptGroup, GroupPlan]:
    """Make a planner of groups that first decides the order of the targets.

    The planner `spacetime` meets one target after another, each as early as possible, by the
    intercept planner `spacetime`.

    Args:
        name: `spacetime`, or a planner of another package.
        decide: "best" plans the most promising of all orders and selects the earliest last meeting,
            "greedy" meets next the target with the earliest estimated meeting, "given" takes the
            order of the cases. A decision with settings, such as `Best(finalists=3)`, is also
            accepted.
        **options: fields of that planner's dataclass.

    Returns:
        A planner for `pj.plan`; its `planner` is a `GroupIntercept`.

    Raises:
        ValueError: there is no planner or decision of that name.
        TypeError: the planner has no such field.
    """
    return DecidedPlanner(TASK.make_planner(name, options), find_decision(DECISIONS, decide))


def judge(cases: InterceptGroup, plans: GroupPlan, **settings: object) -> InterceptVerdict:
    """Judge every leg of one plan, or of a batch of plans; see `referee_groups`.

    Arguments, result and errors are as for `pj.hit.judge`. The settings are keyword arguments of
    `referee_intercepts`.
    """
    require_settings(referee_intercepts, settings)
    if isinstance(cases, InterceptGroup):
        settings = {**position_setting(cases.shared.target), **settings}
    return judge_by(referee_groups, cases, plans, (InterceptGroup, GroupPlan), settings)
