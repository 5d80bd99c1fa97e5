"""The public functions `planner` and `judge` of the task `pj.reach`."""

from planner_jax.referee.reach import ReachVerdict, referee_reaches
from planner_jax.task.arguments import judge_by
from planner_jax.task.reach.case import ReachCase
from planner_jax.task.reach.default_planner import ReachPlan, ReachPlanner


def planner(**options: object) -> ReachPlanner:
    """Make the planner of joint motions; the options are fields of `ReachPlanner`."""
    return ReachPlanner(**options)  # type: ignore[arg-type]


def judge(cases: ReachCase, plans: ReachPlan, **settings: object) -> ReachVerdict:
    """Judge one plan, or a batch, by MuJoCo's distances and the limits of the joints.

    The verdict has the batch shape of the cases: `success`, reasons by `sentence(k)`, and measured
    quantities. The settings are keyword arguments of `referee_reaches`. `TypeError` is raised for
    cases of other tasks, `ValueError` for different batch shapes or invalid settings, and
    `ModuleNotFoundError` without MuJoCo, which the extra `sims` installs.
    """
    return judge_by(referee_reaches, cases, plans, (ReachCase, ReachPlan), settings)
