"""Public functions of the task `pj.rally`, in which a quadrotor hits a ball again and again."""

from planner_jax.core.planner import Planner
from planner_jax.referee.rally import RallyVerdict, referee_rallies
from planner_jax.task.arguments import judge_by
from planner_jax.task.rally.case import RallyCase
from planner_jax.task.rally.plan import RallyPlan
from planner_jax.task.rally.spec import TASK


def planner(
    name: str = "exact", *, effort: str = "feasible", **options: object
) -> Planner[RallyCase, RallyPlan]:
    """Make a planner of rallies by its name.

    Args:
        name: `exact`, which plans all hits together and meets every contact and place exactly, or
            the name of a planner of another package.
        effort: "feasible" stops as soon as every limit holds; "good" and "best" lower the cost.
        **options: `attempts`, and fields of the problem's dataclass, such as `margin`.

    Returns:
        A `SearchPlanner` of a `RallyProblem`, for `pj.plan` and `pj.replan`.

    Raises:
        ValueError: no planner has the requested name, or it does not support the effort.
        TypeError: there is no field of the name of an option.
    """
    return TASK.make_planner(name, options).with_effort(effort)


def judge(cases: RallyCase, plans: RallyPlan, **settings: object) -> RallyVerdict:
    """Judge one plan, or a batch of plans, by physics that is independent of the planners.

    The verdict has the batch shape of the cases: `success`, reasons by `sentence(k)`, and measured
    quantities. The settings are keyword arguments of `referee_rallies`. `TypeError` is raised for
    cases of other tasks, `ValueError` for different batch shapes or invalid settings.
    """
    return judge_by(referee_rallies, cases, plans, (RallyCase, RallyPlan), settings)
