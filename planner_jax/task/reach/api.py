"""The public functions `planner` and `judge` of the task `pj.reach`."""

from planner_jax.core.planner import Planner
from planner_jax.referee.reach import ReachVerdict, referee_reaches
from planner_jax.task.arguments import judge_by
from planner_jax.task.reach.case import ReachCase
from planner_jax.task.reach.default_planner import ReachPlan
from planner_jax.task.reach.spec import TASK


def planner(name: str = "shortcuts", **options: object) -> Planner[ReachCase, ReachPlan]:
    """Make a planner of joint motions by its name.

    * `shortcuts`: the fastest motion if it is free of collisions, else the straight motion. If both
      collide, RRT-Connect finds a path, and random shortcuts in time make the motion along the path
      faster.

    Planners of other packages are also found by name.

    Args:
        name: name of the planner, as listed above.
        options: fields of the planner's class, `ReachPlanner`.

    Raises:
        ValueError: no planner has the requested name.
        TypeError: an option is unknown.
    """
    return TASK.make_planner(name, options)


def judge(cases: ReachCase, plans: ReachPlan, **settings: object) -> ReachVerdict:
    """Judge one plan, or a batch, by MuJoCo's distances and the limits of the joints.

    The verdict has the batch shape of the cases: `success`, reasons by `sentence(k)`, and measured
    quantities. The settings are keyword arguments of `referee_reaches`. `TypeError` is raised for
    cases of other tasks, `ValueError` for different batch shapes or invalid settings, and
    `ModuleNotFoundError` without MuJoCo, which the extra `sims` installs.
    """
    return judge_by(referee_reaches, cases, plans, (ReachCase, ReachPlan), settings)
